"""COLMAP's sparse models, binary and text: ``cameras``, ``images``, ``points3D`` and, since 3.12, ``frames``.

The formats are those of https://colmap.github.io/format.html and of COLMAP 4's ``reconstruction_io``. Poses are world to camera in OpenCV
axes; principal points have the top-left pixel's centre at 0.5. Every image has its own pose in ``images``, on a rig too: ``frames`` say
which images are of one instant, and what ``rigs`` adds, places on the rig, follows from the poses.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.checks import floats, make_camera, rotation_of, text_lines
from mmsynth.scene.points import SparsePoints
from mmsynth.scene.scene import StatedPose
from mmsynth.sensors.camera import COEFFICIENTS, MAX_SIZE, Camera, Lens

_LINE = "id qw qx qy qz tx ty tz camera name"
# what each parameter of a camera model is, in file order; these are the models that this library has
_SUPPORTED = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
}
# by the number that stands for it in cameras.bin
_IDS = {
    0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 5: "OPENCV_FISHEYE", 6: "FULL_OPENCV", 7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION",
    13: "DIVISION", 14: "SIMPLE_FISHEYE", 15: "FISHEYE", 16: "EUCM", 17: "EQUIRECTANGULAR",
}  # fmt: skip


@dataclass(frozen=True)
class ModelImage:
    """An image of a model.

    Attributes:
        camera: None where the model's cameras are not there (poses alone).
        camera_to_world: (4, 4) float64, OpenCV axes.
        frame: id of the instant that a rig took several images at; None where the model has no rig.
    """

    name: str
    camera_id: int
    camera: Camera | None
    camera_to_world: np.ndarray
    frame: int | None = None


def is_model(folder: Path) -> bool:
    """Whether cameras and images of a model are in a folder."""
    return any((folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))


def missing_of_model(folder: Path) -> str | None:
    """What a folder lacks that holds one of the two files of a model; None where it has both, or neither."""
    held = [path.name for stem in ("cameras", "images") for suffix in (".bin", ".txt") if (path := folder / f"{stem}{suffix}").is_file()]
    if not held or is_model(folder):
        return None
    other = {"cameras": "images", "images": "cameras"}
    return f"{held[0]} without {other[Path(held[0]).stem]}{Path(held[0]).suffix}"


def read_model(folder: Path) -> list[ModelImage]:
    """The images of a model, by name; binary files are read where both are there.

    Raises:
        InputError: damaged files, a camera that is missing or of a model that is not supported, a pose that is none.
    """
    suffix = ".bin" if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file() else ".txt"
    return _images(folder / f"images{suffix}")


def read_model_poses(path: Path) -> list[StatedPose]:
    """The poses of ``images.txt`` or ``images.bin``, in file order; with their cameras where those are beside it."""
    suffix = path.suffix.lower()
    listed = _images_bin(path) if suffix == ".bin" else _images_txt(path)
    cameras = _cameras(path.with_name(f"cameras{suffix}"))
    return [StatedPose(_camera_of(one, cameras, path), one.camera_to_world, PurePosixPath(one.name).stem) for one in listed]


def read_points(folder: Path) -> SparsePoints | None:
    """The points of a model that three images or more see; None where it has none."""
    binary, text = folder / "points3D.bin", folder / "points3D.txt"
    listed = _points_bin(binary) if binary.is_file() else _points_txt(text) if text.is_file() else iter(())
    found = [(xyz, rgb) for xyz, rgb, seen in listed if seen >= 3 and np.isfinite(xyz).all()]
    if not found:
        return None
    positions, colours = (np.array(part) for part in zip(*found, strict=True))
    return SparsePoints(positions.astype(np.float64), np.clip(colours, 0, 255).astype(np.uint8))


# --- what both have in common


def _images(path: Path) -> list[ModelImage]:
    binary = path.suffix == ".bin"
    cameras = _cameras(path.with_name(f"cameras{path.suffix}")) or {}
    frames_file = path.with_name(f"frames{path.suffix}")
    frames: dict[int, int] = {}
    if frames_file.is_file():
        frames = _rig_frames(_frames_bin(frames_file) if binary else _frames_txt(frames_file))
    listed = _images_bin(path) if binary else _images_txt(path)
    names = [one.name for one in listed]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: the image '{twice}' is listed twice, expected every name once.")
    out = [
        ModelImage(one.name, one.camera_id, _camera_of(one, cameras, path), one.camera_to_world, frames.get(one.identity)) for one in listed
    ]
    return sorted(out, key=lambda image: image.name)


@dataclass(frozen=True)
class _Listed:
    """An image as ``images`` lists it."""

    identity: int
    name: str
    camera_id: int
    camera_to_world: np.ndarray


def _camera_of(image: _Listed, cameras: dict[int, Camera] | None, path: Path) -> Camera | None:
    if cameras is None:
        return None
    if image.camera_id not in cameras:
        cameras_file = path.with_name(f"cameras{path.suffix}")
        raise InputError(f"{path}: image '{image.name}': camera {image.camera_id} is not in {cameras_file}.")
    return cameras[image.camera_id]


def _cameras(path: Path) -> dict[int, Camera] | None:
    if not path.is_file():
        return None
    return dict(_cameras_bin(path) if path.suffix == ".bin" else _cameras_txt(path))


def _camera(model: str, size: tuple[int, int], parameters: Sequence[float], where: str) -> Camera:
    names = _SUPPORTED[model].split()
    if len(parameters) != len(names):
        raise InputError(f"{where}: {len(parameters)} numbers, expected {len(names)} ({' '.join(names)}) after the size.")
    value = dict(zip(names, parameters, strict=True))
    lens: Lens = "kannala_brandt" if model.endswith("FISHEYE") else "brown_conrady"
    distortion = [value.get(key, 0.0) for key in COEFFICIENTS[lens]]
    fx, fy = (value[key] if key in value else value["f"] for key in ("fx", "fy"))
    return make_camera(where, size, (fx, fy, value["cx"] - 0.5, value["cy"] - 0.5), distortion, lens)


def _unsupported(model: str, where: str) -> InputError:
    return InputError(f"{where}: unsupported camera {model}, expected one of the models {' '.join(_SUPPORTED)}.")


def _pose(values: np.ndarray, where: str) -> np.ndarray:
    """qw qx qy qz tx ty tz, world to camera → (4, 4) camera to world."""
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = rotation_of(values[:4], where).T
    camera_to_world[:3, 3] = -camera_to_world[:3, :3] @ values[4:7]
    return camera_to_world


def _rig_frames(frames: Iterator[tuple[int, list[int]]]) -> dict[int, int]:
    """Image → frame, of models with a rig: where some frame has more than one image."""
    listed = list(frames)
    if all(len(images) < 2 for _, images in listed):
        return {}
    return {image: frame for frame, images in listed for image in images}


# --- text


def _images_txt(path: Path) -> list[_Listed]:
    """Every image takes two lines, ``id qw qx qy qz tx ty tz camera name`` and its 2-D points."""
    out: list[_Listed] = []
    points_expected = False
    for where, tokens in text_lines(path):
        # a points line holds triples and may be empty or, in some files, left out; an image line never has 3 n tokens
        # unless the name has spaces, and then it comes where no points line is expected
        if points_expected and len(tokens) % 3 == 0:
            points_expected = False
            continue
        if not tokens:
            continue
        if len(tokens) < 10:
            raise InputError(f"{where}: {len(tokens)} values, expected '{_LINE}'.")
        values = floats(tokens[1:8], where, _LINE)
        identity = _whole(tokens[0], where, "image", _LINE)
        camera_id = _whole(tokens[8], where, "camera", _LINE)
        out.append(_Listed(identity, " ".join(tokens[9:]), camera_id, _pose(values, where)))
        points_expected = True
    return out


def _cameras_txt(path: Path) -> Iterator[tuple[int, Camera]]:
    line = "id model width height ..."
    for where, tokens in text_lines(path):
        if not tokens:
            continue
        if len(tokens) < 4:
            raise InputError(f"{where}: {len(tokens)} values, expected '{line}'.")
        if tokens[1] not in _SUPPORTED:
            raise _unsupported(tokens[1], where)
        identity, width, height = (_whole(token, where, "value", line) for token in (tokens[0], tokens[2], tokens[3]))
        parameters = floats(tokens[4:], where, f"id model width height {_SUPPORTED[tokens[1]]}")
        yield identity, _camera(tokens[1], (width, height), parameters.tolist(), where)


def _points_txt(path: Path) -> Iterator[tuple[Sequence[float], Sequence[float], int]]:
    line = "id x y z r g b error track"
    for where, tokens in text_lines(path):
        if tokens:
            if len(tokens) < 8:
                raise InputError(f"{where}: {len(tokens)} values, expected '{line}'.")
            values = floats(tokens[1:7], where, line).tolist()
            yield values[:3], values[3:], (len(tokens) - 8) // 2


def _frames_txt(path: Path) -> Iterator[tuple[int, list[int]]]:
    line = "frame rig qw qx qy qz tx ty tz count (type sensor data)..."
    for where, tokens in text_lines(path):
        if tokens:
            data = tokens[10:]
            if len(tokens) < 10 or len(data) != 3 * _whole(tokens[9], where, "count", line):
                raise InputError(f"{where}: {len(tokens)} values, expected '{line}'.")
            triples = zip(data[::3], data[2::3], strict=True)
            images = [_whole(identity, where, "data", line) for kind, identity in triples if kind == "CAMERA"]
            yield _whole(tokens[0], where, "frame", line), images


def _whole(token: str, where: str, what: str, line: str) -> int:
    if not token.isdecimal() or len(token) > 18:
        raise InputError(f"{where}: {what} {token[:40]} is not a whole number, expected '{line}'.")
    return int(token)


# --- binary: little endian


class _Bytes:
    """Values of a binary file, one after the other."""

    def __init__(self, path: Path) -> None:
        self.path, self.position = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: could not be read ({error.strerror}).") from error

    def take(self, layout: str) -> tuple[Any, ...]:
        """What a struct layout says comes next."""
        size = struct.calcsize(f"<{layout}")
        self.skip(size)
        return struct.unpack_from(f"<{layout}", self.data, self.position - size)

    def skip(self, size: int) -> None:
        if self.position + size > len(self.data):
            raise InputError(f"{self.path}: truncated at byte {len(self.data)}, expected more of it.")
        self.position += size

    def text(self) -> str:
        """A name that ends with a zero."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise InputError(f"{self.path}: truncated at byte {len(self.data)}, expected the end of a name.")
        found, self.position = self.data[self.position : end], end + 1
        try:
            return found.decode()
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path}: a name at byte {end - len(found)} is not UTF-8 text.") from error


def _cameras_bin(path: Path) -> Iterator[tuple[int, Camera]]:
    file = _Bytes(path)
    (count,) = file.take("Q")
    for _ in range(count):
        identity, model, width, height = file.take("IiQQ")
        where = f"{path}: camera {identity}"
        name = _IDS.get(model, f"number {model}")
        if name not in _SUPPORTED:
            raise _unsupported(name, where)
        if max(width, height) > MAX_SIZE:
            raise InputError(f"{where}: size {width}x{height}, expected at most {MAX_SIZE} a side.")
        parameters = file.take(f"{len(_SUPPORTED[name].split())}d")
        yield identity, _camera(name, (width, height), parameters, where)


def _images_bin(path: Path) -> list[_Listed]:
    file = _Bytes(path)
    (count,) = file.take("Q")
    out: list[_Listed] = []
    for _ in range(count):
        identity, *values, camera_id = file.take("I7dI")
        name = file.text()
        (points,) = file.take("Q")
        file.skip(24 * points)
        where = f"{path}: image {identity}"
        if not np.isfinite(values).all():
            raise InputError(f"{where}: its pose is not finite, expected a quaternion and a translation.")
        out.append(_Listed(identity, name, camera_id, _pose(np.array(values), where)))
    return out


def _points_bin(path: Path) -> Iterator[tuple[Sequence[float], Sequence[float], int]]:
    file = _Bytes(path)
    (count,) = file.take("Q")
    for _ in range(count):
        _, *values, _, seen = file.take("Q3d3BdQ")
        file.skip(8 * seen)
        yield values[:3], values[3:], seen


def _frames_bin(path: Path) -> Iterator[tuple[int, list[int]]]:
    file = _Bytes(path)
    (count,) = file.take("Q")
    for _ in range(count):
        frame, _, *_, data = file.take("II7dI")
        triples = [file.take("iIQ") for _ in range(data)]
        yield frame, [identity for kind, _, identity in triples if kind == 0]  # 0: a camera
