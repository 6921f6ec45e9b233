"""``report.html`` of a calibration: residuals, coverage by corners, the rig drawn, every frame that was left out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mmsynth.report.page import links_to, svg, write_page
from mmsynth.scene.capture.board import corner_points
from mmsynth.scene.capture.calibrate import Calibration
from mmsynth.sensors.camera import COEFFICIENTS, unproject

_AXIS = 0.15  # of the rig's extent: how long cameras are drawn
_BOARDS = 40  # boards drawn at the most

_BODY = """\
{% if problems %}<h2 id="know">To know</h2><ul>{% for line in problems %}<li>{{ line }}</li>{% endfor %}</ul>{% endif %}
{% for heading, header, rows, note in tables %}<h2 id="table-{{ loop.index }}">{{ heading }}</h2>
{% if rows %}{{ table(heading, header, rows) }}{% endif %}<p class="note">{{ note }}</p>{% endfor %}
<h2 id="residuals">Residuals and coverage</h2>
{{ drawing(residuals, "residuals of the corners at their places in the pictures, and their scatter",
"Left: every corner at its place in the picture with its residual, enlarged as said. Right: all residuals [px].") }}
<h2 id="rig">The rig</h2>
{{ drawing(rig, "cameras and boards from above and from behind",
"Cameras look along their blue axis; boards in grey, in the reference's frame [m].") }}
<h2 id="boards">Residuals of every board</h2>{{ drawing(boards, "rms of the residuals of every board over the instants") }}
<h2 id="files">Files</h2>{{ links(files) }}
"""


def write_calibration_report(path: Path, calibration: Calibration, files: Sequence[tuple[str, str]] = ()) -> None:
    """Write the page; ``files``: name and meaning of those beside it. Raises InputError: cannot be written."""
    order = list(calibration.rig)
    page = {
        "title": f"Calibration of {len(order)} sensor{'s' if len(order) > 1 else ''}: {', '.join(order)}",
        "subtitle": f"Reference: {order[0]}. Boards: {', '.join(map(str, calibration.boards))}. {len(calibration.seen)} sightings used.",
        "problems": calibration.problems,
        "tables": [_sensors(calibration), _cameras(calibration), _left_out(calibration)],
        "residuals": svg(_residuals(calibration)),
        "rig": svg(_rig(calibration)),
        "boards": svg(_by_board(calibration)),
        "files": links_to(path.parent, files),
    }
    write_page(path, _BODY, page)


_Table = tuple[str, list[str], list[list[str]], str]


def _sensors(calibration: Calibration) -> _Table:
    header = [
        "sensor",
        "lens model",
        "boards",
        "corners",
        "coverage",
        "rms [px]",
        "corner's deviation [px]",
        "held-out error of models [px]",
    ]
    rows = [
        [
            name, s.model, f"{s.boards} in {s.frames} frames",
             str(s.corners), f"{100 * s.coverage:.0f} %", f"{s.rms:.3f}", f"{s.sigma:.3f}",
            ", ".join(f"{model} {error:.3f}" for model, error in s.held_out.items()),
        ]
        for name, s in calibration.sensors.items()
    ]  # fmt: skip
    return (
        "Sensors",
        header,
        rows,
        "rms: of the residuals' lengths. The held-out error is the median's, as of normal residuals of one coordinate.",
    )


def _cameras(calibration: Calibration) -> _Table:
    rows = []
    for name, sensor in calibration.rig.items():
        spread, camera = calibration.sensors[name].deviations, sensor.camera
        values = dict(zip(("fx", "fy", "cx", "cy"), camera.intrinsics, strict=True))
        values |= dict(zip(COEFFICIENTS[camera.lens], camera.coefficients, strict=True))
        cells = [f"{key} {values[key]:.6g} ± {spread[key]:.2g}" for key in values if key in spread]
        place = "reference"
        if "position" in spread:
            x, y, z = (
                f"{1000 * v:.2f} ± {1000 * d:.2g}" for v, d in zip(sensor.camera_to_reference[:3, 3], spread["position"], strict=True)
            )
            place = f"({x}, {y}, {z}) mm, rotation ± {max(spread['rotation']):.2g}°"
        rows.append([name, f"{camera.width}x{camera.height}", "; ".join(cells), place])
    return (
        "Parameters",
        ["sensor", "size", "intrinsics and lens", "place on the rig"],
        rows,
        "± is one standard deviation, by the corners' scatter.",
    )


def _left_out(calibration: Calibration) -> _Table:
    rows = [
        [out.sensor, out.instant, "" if out.board is None else str(calibration.boards[out.board]), out.why] for out in calibration.left_out
    ]
    return (
        "Left out",
        ["sensor", "instant", "board", "why"],
        rows,
        "" if rows else "Nothing: every frame shows a board, and every board fits.",
    )


def _residuals(calibration: Calibration) -> Figure:
    names = list(calibration.rig)
    figure = Figure(figsize=(10, 3.6 * len(names)), layout="constrained")
    grid = figure.subplots(len(names), 2, squeeze=False, width_ratios=[3, 2])
    for (left, right), name in zip(grid, names, strict=True):
        own = [seen for seen in calibration.seen if seen.sensor == name]
        pixels, residuals = np.concatenate([s.pixels for s in own]), np.concatenate([s.residuals for s in own])
        camera, rms = calibration.rig[name].camera, calibration.sensors[name].rms
        enlarged = 10 ** np.floor(np.log10(max(camera.width / 20 / max(rms, 1e-6), 1.0)))
        left.quiver(*pixels.T, *(residuals * enlarged).T, angles="xy", scale_units="xy", scale=1, width=0.0015, color="#35c")
        left.set(
            xlim=(-0.5, camera.width - 0.5), ylim=(camera.height - 0.5, -0.5), aspect="equal", title=f"{name}: residuals x {enlarged:g}"
        )
        right.plot(*residuals.T, ".", ms=2, color="#35c", alpha=0.6)
        right.set(aspect="equal", xlabel="column [px]", ylabel="row [px]", title=f"rms {rms:.3f} px")
        right.grid(alpha=0.25)
    return figure


def _rig(calibration: Calibration) -> Figure:
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    above, beside = figure.subplots(1, 2)
    places = np.stack([sensor.camera_to_reference for sensor in calibration.rig.values()])
    boards = list(calibration.poses.items())[:: max(1, len(calibration.poses) // _BOARDS)]
    extent = max(float(np.ptp(places[:, :3, 3], axis=0).max()), 0.2 * float(np.median([abs(pose[2, 3]) for _, pose in boards])))
    for axes, (i, j), labels in ((above, (0, 2), ("x", "z")), (beside, (0, 1), ("x", "y"))):
        for (_, board), pose in boards:
            points = corner_points(calibration.boards[board])
            hull = (
                points[[0, calibration.boards[board].grid[0] - 1, -1, -calibration.boards[board].grid[0], 0]] @ pose[:3, :3].T + pose[:3, 3]
            )
            axes.plot(hull[:, i], hull[:, j], color="#bbb", lw=0.7)
        for name, sensor in calibration.rig.items():
            _camera(axes, sensor.camera_to_reference, i, j, _AXIS * extent)
            axes.annotate(name, sensor.camera_to_reference[[i, j], 3], fontsize=8, xytext=(3, 3), textcoords="offset points")
            camera = sensor.camera
            ends = (
                unproject(np.array([[0.0, camera.cy], [camera.width - 1.0, camera.cy]]), camera)[0] @ sensor.camera_to_reference[:3, :3].T
            )
            for end in ends:
                line = sensor.camera_to_reference[:3, 3] + np.stack([0 * end, end]) * 2 * _AXIS * extent
                axes.plot(line[:, i], line[:, j], color="#35c", lw=0.4)
        axes.set(aspect="equal", xlabel=f"{labels[0]} [m]", ylabel=f"{labels[1]} [m]")
        axes.grid(alpha=0.25)
    beside.invert_yaxis()
    above.set_title("from above")
    beside.set_title("from behind")
    return figure


def _camera(axes: Axes, pose: np.ndarray, i: int, j: int, length: float) -> None:
    for axis, colour in enumerate(("#c33", "#3a3", "#35c")):
        line = pose[:3, 3] + np.stack([np.zeros(3), pose[:3, axis] * length])
        axes.plot(line[:, i], line[:, j], color=colour, lw=1.5)


def _by_board(calibration: Calibration) -> Figure:
    figure = Figure(figsize=(10, 3), layout="constrained")
    axes = figure.subplots()
    instants = sorted({seen.instant for seen in calibration.seen})
    at = {instant: i for i, instant in enumerate(instants)}
    for name in calibration.rig:
        own = [seen for seen in calibration.seen if seen.sensor == name]
        axes.plot([at[seen.instant] for seen in own], [seen.rms for seen in own], ".", label=name)
    step = max(1, len(instants) // 25)
    axes.set_xticks(range(0, len(instants), step), instants[::step], rotation=90, fontsize=7)
    axes.set(ylabel="rms of a board [px]", ylim=(0, None))
    axes.legend(frameon=False, fontsize=8)
    axes.grid(alpha=0.25)
    return figure


def calibration_to_json(calibration: Calibration) -> dict[str, Any]:
    """What the page says, as numbers: sensors with deviations, sightings with their rms, and what was left out."""
    return {
        "reference": next(iter(calibration.rig)),
        "boards": [str(board) for board in calibration.boards],
        "sensors": {
            name: {
                "model": s.model, "rms": s.rms, "sigma": s.sigma, "boards": s.boards, "frames": s.frames, "corners": s.corners,
                "coverage": s.coverage, "held_out": dict(s.held_out), "deviations": dict(s.deviations), "blind": [list(p) for p in s.blind],
            }
            for name, s in calibration.sensors.items()
        },
        "sightings": [
            {"sensor": s.sensor, "instant": s.instant, "board": s.board, "corners": len(s.ids), "rms": s.rms} for s in calibration.seen
        ],
        "left_out": [{"sensor": o.sensor, "instant": o.instant, "board": o.board, "why": o.why} for o in calibration.left_out],
        "problems": list(calibration.problems),
    }  # fmt: skip
