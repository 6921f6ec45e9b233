"""A rig calibrated from frames of boards, with its files and report."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mmsynth.files import write_json
from mmsynth.report.calibration import calibration_to_json, write_calibration_report
from mmsynth.scene.capture.board import read_boards
from mmsynth.scene.capture.calibrate import Calibration, calibrate
from mmsynth.scene.layouts.calibration import write_calibration


def calibrate_rig(
    folder: Path, board: Path, out: Path, *, reference: str | None = None, progress: Callable[[int, int], Any] | None = None
) -> Calibration:
    """Calibrate the sensors whose board frames are in a folder, and write ``out`` with two files beside it.

    Args:
        folder: ``<sensor>/<instant>.<suffix>``. board: ``board.toml``. reference: as ``calibrate``.
        out: ``calibration.json``; ``<name>_report.json`` and ``report.html`` are written beside it, with deviations and what was left out.
    Raises:
        InputError: as ``read_boards`` and ``calibrate``, or a file cannot be written.
    """
    calibration = calibrate(folder, read_boards(board), reference=reference, progress=progress)
    numbers = out.with_name(f"{out.stem}_report.json")
    write_json(numbers, calibration_to_json(calibration))
    write_calibration(out, calibration.rig)
    files = [(out.name, "the rig"), (numbers.name, "deviations, residuals of every board, what was left out")]
    write_calibration_report(out.with_name("report.html"), calibration, files)
    return calibration
