"""Commands that lead from pictures on disk to a scene: calibrate, pose."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from mmsynth.cli.arguments import JsonOption
from mmsynth.cli.terminal import command, progress_bar


@command("calibrate")
def calibrate(
    boards: Annotated[
        Path, typer.Argument(metavar="BOARDS", help="folder with SENSOR/INSTANT.png; equal names are one instant of the rig")
    ],
    board: Annotated[Path, typer.Option(help="board.toml: what is printed on the boards")],
    reference: Annotated[str | None, typer.Option(help="sensor that the others are placed by; default: rgb, else the first")] = None,
    out: Annotated[Path, typer.Option(help="report.html and the deviations are written beside it")] = Path("calibration.json"),
    as_json: JsonOption = False,
) -> None:
    """Calibrate sensors from raw frames of boards: intrinsics, lenses, and their places on the rig."""
    from mmsynth.report.calibration import calibration_to_json
    from mmsynth.workflows.calibrate import calibrate_rig

    with progress_bar("boards", as_json) as show:
        result = calibrate_rig(boards, board, out, reference=reference, progress=show)
    if as_json:
        print(json.dumps({"out": str(out), "report": str(out.with_name("report.html")), **calibration_to_json(result)}))
        return
    for name, sensor in result.sensors.items():
        camera, place = result.rig[name].camera, ""
        if "position" in sensor.deviations:
            x, y, z = 1000 * result.rig[name].camera_to_reference[:3, 3]
            place = f", at ({x:.2f}, {y:.2f}, {z:.2f}) ± {1000 * max(sensor.deviations['position']):.2f} mm"
        print(
            f"{name}: {sensor.model}, f = {camera.fx:.2f} ± {sensor.deviations['fx']:.2f} px, rms {sensor.rms:.3f} px, "
            f"{sensor.corners} corners on {sensor.boards} boards in {sensor.frames} frames{place}"
        )
    for left in result.left_out:
        print(f"left out: {left.sensor} {left.instant}{'' if left.board is None else f', {result.boards[left.board]}'}: {left.why}")
    for problem in result.problems:
        print(problem)
    print(f"wrote {out}, {out.stem}_report.json and report.html")


@command("pose")
def pose(
    capture: Annotated[Path, typer.Argument(help="a folder of photographs, one folder for each sensor, or a source scene of MMS-DATA")],
    calibration: Annotated[Path | None, typer.Option(help="calibration.json of the rig; default: the capture's own")] = None,
    board: Annotated[Path | None, typer.Option(help="board.toml of boards in the scene, for metres")] = None,
    reference: Annotated[str | None, typer.Option(help="sensor that the others stand by; default: the calibration's first, or rgb")] = None,
    out: Annotated[Path | None, typer.Option(help="the scene's folder; default: NAME_scene")] = None,
    as_json: JsonOption = False,
) -> None:
    """Find where pictures were taken, and make a scene of them."""
    from mmsynth.report.pose import pose_text
    from mmsynth.workflows.pose import pose_scene

    with progress_bar("pose", as_json) as show:
        facts = pose_scene(capture, out, calibration=calibration, board=board, reference=reference, progress=show)
    print(json.dumps(facts) if as_json else pose_text(facts))
