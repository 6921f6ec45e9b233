"""Checks of what files hold: each gives the value in the library's own type, or an InputError of one sentence.

``where`` is the file and the place in it (or the file alone), with which the sentence begins.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_text
from mmsynth.sensors.camera import Camera, Lens


def is_number(value: Any) -> TypeGuard[float]:
    """Whether it is a finite number that a float can hold."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer of more than 308 digits
        return False


def number(
    entry: Mapping[str, Any], key: str, where: str, low: float = -math.inf, high: float = math.inf, default: float | None = None
) -> float:
    """``entry[key]`` as a finite float, from ``low`` to ``high``; the default, if there is one, where the key is missing."""
    value = entry.get(key, default)
    if not is_number(value) or not low <= value <= high:
        expected = "a finite number" if math.isinf(low) else f"a number from {low:g} to {high:g}"
        raise InputError(f"{where}: key '{key}' is {'missing' if key not in entry else repr(value)}, expected {expected}.")
    return float(value)


def whole(entry: Mapping[str, Any], key: str, where: str, low: float = -math.inf, high: float = math.inf) -> int:
    """``entry[key]`` as an int (1080.0 is accepted), as ``number``."""
    value = number(entry, key, where, low, high)
    if value != int(value):
        raise InputError(f"{where}: key '{key}' is {value}, expected a whole number.")
    return int(value)


def objects(entry: Mapping[str, Any], key: str, where: str | Path) -> list[dict[str, Any]]:
    """``entry[key]`` as a list of objects."""
    value = entry.get(key)
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise InputError(f"{where}: key '{key}' is not a list of objects.")
    return value


def view_ids(entry: Mapping[str, Any], key: str, where: str | Path) -> list[int]:
    """``entry[key]`` as a list of whole numbers, empty where the key is missing."""
    value = entry.get(key, [])
    if not isinstance(value, list) or not all(isinstance(view, int) and not isinstance(view, bool) for view in value):
        raise InputError(f"{where}: key '{key}' is not a list of view ids.")
    return value


def numbers(value: Any, otherwise: str) -> np.ndarray:
    """Numbers, in lists or not, as a float64 array, which may hold NaN; ``otherwise``: what the error says."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(otherwise) from error


def is_file(path: Path) -> bool:
    """Whether there is one; a name that no file can have (too long, NUL in it) has none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def rigid_pose(matrix: Any, where: str, tolerance: float = 1e-4) -> np.ndarray:
    """Check that a 3x4 or 4x4 matrix is a rigid motion, and remove its rounding errors.

    Args:
        matrix: nested lists or array.
        tolerance: largest accepted entry of |R Rᵀ - 1|; errors below it are removed by taking the nearest rotation (SVD).
    Returns:
        (4, 4) float64.
    Raises:
        InputError: wrong shape, NaN, scale, shear, reflection, or a last row other than 0 0 0 1.
    """
    if matrix is None:
        raise InputError(f"{where}: the camera-to-world matrix is missing, expected 4x4 or 3x4.")
    pose = numbers(matrix, f"{where}: the pose is not a matrix of numbers, expected 4x4 or 3x4.")
    if pose.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{where}: the pose has the shape {pose.shape}, expected 4x4 or 3x4.")
    if not np.isfinite(pose).all():
        row, column = np.argwhere(~np.isfinite(pose))[0]
        raise InputError(f"{where}: the pose is not finite in row {row}, column {column}, expected a rigid camera-to-world matrix.")
    if pose.shape == (4, 4) and np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > tolerance:
        raise InputError(f"{where}: the last row of the pose is {pose[3].tolist()}, expected 0 0 0 1.")
    rotation = pose[:3, :3]
    error_size = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error_size > tolerance:
        raise InputError(f"{where}: the pose is not rigid (R Rᵀ differs from 1 by {error_size:.2g}), expected no scale and no shear.")
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: the pose is a reflection (determinant -1), expected a rotation.")
    u, _, vt = np.linalg.svd(rotation)
    out = np.eye(4)
    out[:3, :3] = u @ vt
    out[:3, 3] = pose[:3, 3]
    return out


def make_camera(
    where: str, size: tuple[int, int], intrinsics: Sequence[float], distortion: Sequence[float] = (), lens: Lens = "brown_conrady"
) -> Camera:
    """A Camera of width, height and fx, fy, cx, cy; no coefficients when all are zero, so that equal cameras compare equal."""
    fx, fy, cx, cy = intrinsics
    try:
        return Camera(*size, fx, fy, cx, cy, tuple(distortion) if any(distortion) else (), lens)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def text_lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """The place and the words of every line of a UTF-8 file that is no comment (#); no words of an empty one."""
    for row, line in enumerate(read_text(path).split("\n"), 1):
        if not line.lstrip().startswith("#"):
            yield f"{path}: line {row}", line.split()


def floats(tokens: Sequence[str], where: str, line: str) -> np.ndarray:
    """Finite numbers of a text line, or an InputError that says what the line should hold."""
    try:
        values = np.array([float(token) for token in tokens])
    except ValueError as error:
        raise InputError(f"{where}: not a number, expected '{line}'.") from error
    if not np.isfinite(values).all():
        raise InputError(f"{where}: a value is not finite, expected '{line}'.")
    return values


def rotation_of(quaternion: np.ndarray, where: str) -> np.ndarray:
    """Quaternion (w, x, y, z), of unit length but for the rounding of its decimals → (3, 3) rotation."""
    from scipy.spatial.transform import Rotation  # a second to import

    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 1e-3:
        raise InputError(f"{where}: the quaternion has the length {norm:.4g}, expected a unit quaternion.")
    return np.asarray(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix())
