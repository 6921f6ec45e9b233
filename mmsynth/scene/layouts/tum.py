"""TUM trajectories: lines ``t tx ty tz qx qy qz qw``, camera to world, OpenCV axes; no intrinsics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.checks import floats, rotation_of, text_lines
from mmsynth.scene.scene import StatedPose

_LINE = "t tx ty tz qx qy qz qw"


def is_tum(path: Path) -> bool:
    """By its name, else by its first line: images of COLMAP have ten values or more."""
    if path.suffix.lower() == ".tum":
        return True
    if path.suffix.lower() != ".txt" or path.name.lower() == "images.txt":
        return False
    return len(next((tokens for _, tokens in text_lines(path) if tokens), [])) <= 8


def read_tum(path: Path) -> list[StatedPose]:
    """The poses; their names are their times as the file spells them.

    Raises:
        InputError: a line that is not of eight finite numbers, or a quaternion that is not of unit length.
    """
    out: list[StatedPose] = []
    for where, tokens in text_lines(path):
        if not tokens:
            continue
        if len(tokens) != 8:
            raise InputError(f"{where}: {len(tokens)} values, expected '{_LINE}'.")
        values = floats(tokens, where, _LINE)
        pose = np.eye(4)
        pose[:3, :3] = rotation_of(values[[7, 4, 5, 6]], where)
        pose[:3, 3] = values[1:4]
        out.append(StatedPose(None, pose, tokens[0]))
    return out
