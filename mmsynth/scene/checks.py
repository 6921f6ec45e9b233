"""Checks of what files hold: each gives the value in the library's own type, or an InputError of one sentence.

``where`` is the file and the place in it (or the file alone), with which the sentence begins.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from mmsynth.errors import InputError
from mmsynth.sensors.camera import Camera, Lens


def is_number(value: Any) -> TypeGuard[float]:
    """Whether it is a finite number that a float can hold."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer of more than 308 digits
        return False


def number(entry: Mapping[str, Any], key: str, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    """``entry[key]`` as a finite float; from ``low`` to ``high``."""
    value = entry.get(key)
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
    where: str,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    distortion: Sequence[float] = (),
    lens: Lens = "brown_conrady",
) -> Camera:
    """A Camera whose errors name the file; no coefficients when all are zero, so that equal cameras compare equal."""
    try:
        return Camera(width, height, fx, fy, cx, cy, tuple(distortion) if any(distortion) else (), lens)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def text_lines(path: Path) -> list[str]:
    """The lines of a UTF-8 file, without their ends."""
    try:
        return path.read_text(encoding="utf-8").split("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text at byte {error.start}.") from error
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror or error}).") from error


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
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 1e-3:
        raise InputError(f"{where}: the quaternion has the length {norm:.4g}, expected a unit quaternion.")
    w, x, y, z = quaternion / norm
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
