"""Commands that lead from pictures on disk to a scene: pose."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from mmsynth.cli.arguments import JsonOption
from mmsynth.cli.terminal import command, progress_bar


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
