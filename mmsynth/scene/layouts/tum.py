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
    content = (line.split() for line in text_lines(path))
    return len(next((tokens for tokens in content if tokens and not tokens[0].startswith("#")), [])) <= 8


def read_tum(path: Path) -> list[StatedPose]:
    """The poses; their names are their times as the file spells them.

    Raises:
        InputError: a line that is not of eight finite numbers, or a quaternion that is not of unit length.
    """
    out: list[StatedPose] = []
    for row, line in enumerate(text_lines(path), 1):
        tokens = line.split()
        if not tokens or line.lstrip().startswith("#"):
            continue
        where = f"{path}: line {row}"
        if len(tokens) != 8:
            raise InputError(f"{where}: {len(tokens)} values, expected '{_LINE}'.")
        values = floats(tokens, where, _LINE)
        pose = np.eye(4)
        pose[:3, :3] = rotation_of(values[[7, 4, 5, 6]], where)
        pose[:3, 3] = values[1:4]
        out.append(StatedPose(None, pose, tokens[0]))
    return out
