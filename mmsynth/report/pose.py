"""The report of ``mmsynth pose``: cameras and points drawn, residuals by picture, and what was left out, as one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mmsynth.report.page import links_to, svg, write_page
from mmsynth.scene.capture.pose import PosedCapture

_POINTS = 3000  # drawn at the most

_FILES = (
    ("meta_data.json", "the scene: cameras, poses, frames"),
    ("sparse/0/cameras.txt", "COLMAP's model: lenses"),
    ("sparse/0/images.txt", "COLMAP's model: poses"),
    ("sparse/0/points3D.txt", "COLMAP's model: points"),
    ("sparse/0/*.bin", "COLMAP's model"),
)

_BODY = """\
{% for note in notes %}<p class="note">{{ note }}</p>
{% endfor %}
{% for heading, columns, rows in tables if rows %}<h2 id="table-{{ loop.index }}">{{ heading }}</h2>
{{ table(heading, columns, rows) }}{% endfor %}
<h2 id="cameras">Cameras and points</h2>
{{ drawing(drawn, "cameras and points from above and from the side",
"Seen along the mean of the cameras' up axes, and from the side. The circle is the region of interest.") }}
<h2 id="residuals">Reprojection error of every picture</h2>
{{ drawing(residuals, "rms of the reprojection error of every picture, by sensor") }}
{% if files %}<h2 id="files">Files</h2>{{ links(files) }}{% endif %}
"""


def write_pose_report(path: Path, posed: PosedCapture, facts: Mapping[str, Any]) -> Path:
    """Write the page. ``facts``: what ``workflows.pose.pose_facts`` gives."""
    sensors = facts["sensors"]
    intrinsics = [(name, key, f"{value:.6g}") for name, s in sensors.items() for key, value in (s["camera"] or {}).items()]
    page = {
        "title": f"Poses of {posed.capture.root.resolve().name}",
        "subtitle": f"{facts['registered']} of {facts['pictures']} pictures have a pose. Unit: {posed.unit_from}.",
        "notes": list(posed.notes),
        "tables": [
            (
                "Sensors",
                ("sensor", "pictures", "with a pose", "points in a picture", "error [px]"),
                [(n, s["pictures"], s["registered"], f"{s['points']:.0f}", f"{s['error_px']:.3f}") for n, s in sensors.items()],
            ),
            ("Left out", ("sensor", "view", "why"), [(e["sensor"], e["view"], e["why"]) for e in facts["left_out"]]),
            (
                "The rig, refined",
                ("sensor", "moved [mm]", "turned [°]"),
                [(n, f"{1000 * m['length']:.3f}", f"{m['degrees']:.4f}") for n, m in facts["rig_moved"].items()],
            ),
            ("Cameras", ("sensor", "parameter", "value"), intrinsics),
        ],
        "drawn": _drawing(posed),
        "residuals": _residuals(posed),
        "files": links_to(path.parent, _FILES),
    }
    write_page(path, _BODY, page)
    return path


def _drawing(posed: PosedCapture) -> str:
    """Cameras by sensor, with their optical axes, before the sparse points, in two directions."""
    poses = {shot: r.camera_to_world for shot, r in posed.structure.registered.items()}
    up = -np.mean([pose[:3, 1] for pose in poses.values()], axis=0)
    up = up / max(float(np.linalg.norm(up)), 1e-9)
    right = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(up, right), up])
    centre = np.asarray(posed.region.centre)
    points = posed.structure.points[:: max(1, len(posed.structure.points) // _POINTS)]
    centres = np.array([pose[:3, 3] for pose in poses.values()])
    reach = 1.1 * max(float(np.abs(centres - centre).max()), posed.region.radius)
    length = 0.08 * reach
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    for panel, (i, j, title) in zip(figure.subplots(1, 2), ((0, 1, "from above"), (0, 2, "from the side")), strict=True):
        at = (points - centre) @ axes.T
        panel.plot(at[:, i], at[:, j], ".", color="#bbb", markersize=1.5, rasterized=False)
        for k, sensor in enumerate(dict.fromkeys(sensor for sensor, _ in poses)):
            own = np.array([pose for (name, _), pose in poses.items() if name == sensor])
            place = (own[:, :3, 3] - centre) @ axes.T
            tip = place + length * own[:, :3, 2] @ axes.T
            panel.plot(np.stack([place[:, i], tip[:, i]]), np.stack([place[:, j], tip[:, j]]), color=f"C{k}", linewidth=0.8)
            panel.plot(place[:, i], place[:, j], "o", color=f"C{k}", markersize=3, label=sensor)
        angle = np.linspace(0, 2 * np.pi, 100)
        panel.plot(posed.region.radius * np.cos(angle), posed.region.radius * np.sin(angle), color="#888", linewidth=0.8)
        panel.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", title=title, xlabel=f"[{posed.unit}]")
    figure.axes[0].legend(frameon=False)
    return svg(figure)


def _residuals(posed: PosedCapture) -> str:
    figure = Figure(figsize=(11, 3), layout="constrained")
    panel = figure.subplots()
    registered = posed.structure.registered
    for sensor in dict.fromkeys(sensor for sensor, _ in registered):
        own = [(view, r.error) for (name, view), r in registered.items() if name == sensor]
        panel.plot(*zip(*own, strict=True), ".-", linewidth=0.6, label=sensor)
    panel.set(xlabel="view", ylabel="rms [px]", ylim=(0, None))
    panel.grid(alpha=0.25)
    panel.legend(frameon=False)
    return svg(figure)


def pose_text(facts: Mapping[str, Any]) -> str:
    """What ``pose`` found, in some lines."""
    lines = [f"note: {note}" for note in facts["notes"]]
    for name, s in facts["sensors"].items():
        lines.append(
            f"{name}: {s['registered']} of {s['pictures']} pictures have a pose, {s['error_px']:.2f} px over {s['points']:.0f} points each"
        )
    lines += [f"left out: {entry['sensor']} view {entry['view']}: {entry['why']}" for entry in _shown(facts["left_out"])]
    lines += [f"{n}: on the rig moved {1000 * m['length']:.2f} mm, {m['degrees']:.3f}°" for n, m in facts["rig_moved"].items()]
    lines.append(f"unit: {facts['unit_from']}")
    lines.append(
        f"{facts['points']} points, {facts['seconds']:.0f} s; wrote {facts['scene']}/ (meta_data.json, modalities, sparse/0, report.html)"
    )
    return "\n".join(lines)


def _shown(entries: Sequence[Mapping[str, Any]], most: int = 20) -> list[Mapping[str, Any]]:
    return list(entries[:most])
