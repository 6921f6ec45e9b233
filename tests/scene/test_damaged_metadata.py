"""Every file that describes a scene, poses or a sensor, damaged at random: it loads, or it is refused in one sentence that names it."""

from __future__ import annotations

import copy
import io
import json
import random
import struct
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from conftest import HEIGHT, OPENCV_TO_OPENGL, WIDTH, frame_values, ring
from scipy.spatial.transform import Rotation

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.operations.views.trajectories import trajectory_views
from mmsynth.packaged import data_folder
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.load import load_scene, read_poses
from mmsynth.scene.scene import Region
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.sensor_file import load_sensor

# what is too long or too deep for Python's own JSON writer, put in afterwards
_DIGITS, _NESTED = "<digits>", "<nested>"
_VALUES: tuple[Any, ...] = (
    None, True, False, "", "x", "nan", "../..", "transforms.json", "a\0b", "\ud800", "é" * 300, "x" * 5000, "1" * 31, _DIGITS, _NESTED,
    0, 1, -1, 2, 0.5, -0.5, 1e-300, 1e9, -1e9, 1e155, 1e300, float("nan"), float("inf"), -float("inf"),
    10**9, 10**12, 2**31, 2**63, 2**64, 10**31, -(10**31), 10**400, 12345678901234567890123456789.5,
    [], {}, [[]], [None], [{}], {"x": 1}, [0], [1, 2, 3], ["a"], [None] * 4, [[None] * 4] * 4, [[10**31] * 4] * 3, [[10**400] * 4] * 4,
    [[1.0, 2.0], [3.0]], [[float("nan")] * 4] * 4, [[1e300, 0, 0, 0], [0, 1e300, 0, 0], [0, 0, 1e300, 0]], [[0] * 4] * 4,
)  # fmt: skip


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """(container, key) of everything in a JSON value."""
    for key in list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        yield value, key
        yield from _places(value[key])


def _damage(content: Any, dice: random.Random) -> Any:
    """A copy with one to three things wrong: any value, key, list or nesting."""
    content = copy.deepcopy(content)
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        places = list(_places(content))
        if not places:
            return content
        # any key as often as any other, not by how many numbers stand below it
        keys = sorted({str(key) for _, key in places})
        chosen = dice.choice(keys)
        container, key = dice.choice([place for place in places if str(place[1]) == chosen])
        value = container[key]
        way = dice.randrange(12)
        if way == 0:
            del container[key]
        elif way == 1:
            container[key] = [value]
        elif way == 2:
            container[key] = str(value)
        elif way == 3 and isinstance(value, list):
            container[key] = value[: dice.randrange(len(value) + 1)]
        elif way == 4 and isinstance(value, list):
            container[key] = value * dice.choice((2, 100))
        elif way == 5 and isinstance(value, list) and value:
            container[key] = value[0]
        elif way == 6 and isinstance(value, (int, float)):
            container[key] = value * dice.choice((-1, 1.001, 1e3, 1e30, 1e200))
        elif way == 7:
            container[key] = copy.deepcopy(dice.choice(places)[0])
        elif way == 8 and isinstance(container, dict):
            container[dice.choice(("fl_y", "camera_angle_x", "is_fisheye", "view", "unit", "modality", key + "_"))] = dice.choice(_VALUES)
        else:
            container[key] = copy.deepcopy(dice.choice(_VALUES))
    return content


def _as_json(content: Any) -> str:
    text = json.dumps(content).replace(f'"{_DIGITS}"', "9" * 5000)
    return text.replace(f'"{_NESTED}"', "[" * 100_000 + "]" * 100_000)


def _as_damaged_json(content: Any, dice: random.Random) -> bytes:
    if dice.random() < 0.05:
        return _damaged_text(_as_json(content), dice)
    return _as_json(_damage(content, dice)).encode(errors="surrogatepass")


def _damaged_text(text: str, dice: random.Random) -> bytes:
    """Tokens of some lines replaced, lines lost or doubled, the file cut off, or bytes that are no text."""
    lines = text.split("\n")
    for _ in range(dice.choice((1, 1, 2, 3))):
        row = dice.randrange(len(lines))
        tokens = lines[row].split(" ")
        way = dice.randrange(10)
        if way == 0:
            lines.insert(row, lines[dice.randrange(len(lines))])
        elif way == 1:
            del lines[row]
            lines = lines or [""]
        elif way == 2:
            del tokens[dice.randrange(len(tokens))]
        elif way == 3:
            tokens.append(str(dice.choice(_VALUES[:37])))
        elif way == 4:
            return "\n".join(lines).encode(errors="surrogatepass")[: dice.randrange(len(text) + 1)]
        elif way == 5:
            tokens[dice.randrange(len(tokens))] = "9" * 5000
        else:
            tokens[dice.randrange(len(tokens))] = str(dice.choice(_VALUES[:37]))
        if way not in (0, 1):
            lines[row] = " ".join(tokens)
    damaged = "\n".join(lines).encode(errors="surrogatepass")
    return damaged + b"\xff\xfe" if dice.random() < 0.05 else damaged


def _as_damaged_toml(content: Any, dice: random.Random) -> bytes:
    try:
        return tomli_w.dumps(_damage(content, dice)).encode(errors="surrogatepass")
    except (TypeError, AttributeError):  # TOML has no null
        return _damaged_text(tomli_w.dumps(content), dice)


# --- the files


def _pixels(root: Path, names: list[str]) -> None:
    for view, name in enumerate(names):
        write_png16(root / name, frame_values(view, 3))


def _mmsdata(root: Path) -> dict[str, Any]:
    """Raw rgb, and a sensor that describes itself."""
    lens = {
        "width": WIDTH,
        "height": HEIGHT,
        "fx": 25.0,
        "fy": 26.0,
        "cx": 11.7,
        "cy": 8.4,
        "distortion_params": [-0.1, 0.1, 0.0, 0.0, 0.0, 0.0],
    }
    listed = [
        {"frame_id": i, "file_name": f"{i:04d}.png", "camtoworld": (pose @ OPENCV_TO_OPENGL)[:3].tolist()} for i, pose in enumerate(ring(4))
    ]
    for name in ("rgb", "two"):
        for i in range(4):
            write_png16(root / "modalities" / name / f"{i:04d}.png", frame_values(i))
    return {
        "undistorted": False, "raw": True, "pixel_offset": 0.0, "unit": "m", "scene_box": {"radius": 1.0},
        "worldtogt": [[0.0, -0.25, 0.0, 0.1], [0.25, 0.0, 0.0, 0.2], [0.0, 0.0, 0.25, 0.3], [0.0, 0.0, 0.0, 1.0]],
        "modalities": {
            "rgb": {"camera_model": "OPENCV", **lens, "mosaick_pattern": [[1, 2], [0, 1]], "frames": listed},
            "two": {
                **lens, "mosaick_pattern": [[0, 1]], "channels": ["a", "b"], "wavelengths_nm": [500.0, None],
                "polarizer_angles_deg": [0.0, 90.0], "frames": listed,
            },
        },
    }  # fmt: skip


def _transforms(root: Path) -> dict[str, Any]:
    _pixels(root, [f"images/{i:04d}.png" for i in range(4)])
    frames: list[dict[str, Any]] = [
        {"file_path": f"images/{i:04d}.png", "transform_matrix": (pose @ OPENCV_TO_OPENGL).tolist(), "view": i, "modality": "rgb"}
        for i, pose in enumerate(ring(4))
    ]
    frames[0] |= {"camera_model": "OPENCV_FISHEYE", "mask_path": "masks/0000.png"}
    frames[1] |= {"camera_angle_x": 0.8}
    return {
        "fl_x": 25.0, "fl_y": 26.0, "cx": 12.2, "cy": 8.9, "w": float(WIDTH), "h": float(HEIGHT), "k1": -0.12, "k2": 0.09, "p1": 0.01,
        "ply_file_path": "none.ply", "test_filenames": ["images/0001.png"], "train_filenames": ["images/0000.png"], "test_ids": [1],
        "modalities": {"rgb": {"channels": ["R", "G", "B"], "wavelengths_nm": [600.0, 550.0, None]}}, "frames": frames,
    }  # fmt: skip


def _camera_path() -> dict[str, Any]:
    path = [{"camera_to_world": (pose @ OPENCV_TO_OPENGL).ravel().tolist(), "fov": 50.0, "aspect": 1.0} for pose in ring(3)]
    return {"camera_type": "perspective", "render_width": 24, "render_height": 18, "camera_path": path}


def _par(root: Path) -> str:
    _pixels(root, [f"toy{i:04d}.png" for i in range(4)])
    (root / "README.txt").write_text("(-1 -1 -1)\n(1 1 1)\n")
    lines = ["4"]
    for i, pose in enumerate(ring(4)):
        there = np.linalg.inv(pose)
        values = [25.0, 0, 11.7, 0, 26.0, 8.4, 0, 0, 1, *there[:3, :3].ravel(), *there[:3, 3]]
        lines.append(f"toy{i:04d}.png " + " ".join(f"{value:.12f}" for value in values))
    return "\n".join(lines)


_COLMAP = "# images\n1 1 0 0 0 0 0 3 7 a/0000.png\n1.5 2.5 -1\n2 0 1 0 0 0 0.5 3 7 a b/0001.png\n\n"
_CAMERAS = "# cameras\n7 OPENCV 24 18 25 26 12 9 0.1 0.2 0 0\n8 SIMPLE_PINHOLE 24 18 25 12 9\n9 OPENCV_FISHEYE 24 18 25 26 12 9 0 0 0 0"
_TUM = "# t tx ty tz qx qy qz qw\n1305031102.1 0 0 3 0 0 0 1\n1305031102.2 0 0.5 3 1 0 0 0"
_TRAJECTORIES: list[dict[str, Any]] = [
    {"trajectory": "orbit", "views": 3, "elevation_deg": 25, "radius": 2.0},
    {"trajectory": "hemisphere", "views": 3, "min_elevation_deg": 10},
    {"trajectory": "spiral", "views": 3, "turns": 2, "min_elevation_deg": 10, "max_elevation_deg": 60},
    {"trajectory": "interpolate", "views": 3},
    {"trajectory": "perturb", "per_pose": 2, "rotation_deg": 3, "translation": 0.05, "seed": 0},
]


def _trajectory(path: Path) -> object:
    content = read_json(path)
    long = isinstance(content, dict) and any(isinstance(content.get(k), int) and 100 < content[k] < 10**6 for k in ("views", "per_pose"))
    if long or not isinstance(content, dict):
        return None  # right, and slow; no trajectory
    return trajectory_views(content, Region((0.0, 0.0, 0.0), 1.0), Camera(24, 18, 25.0, 25.0, 11.5, 8.5), ring(4), str(path))


def _cameras(root: Path) -> str:
    (root / "images.txt").write_text(_COLMAP)
    return _CAMERAS


def _rig() -> dict[str, Any]:
    return {"convention": "OpenCV", "rig": [pose.tolist() for pose in ring(3)]}


def _sensor() -> dict[str, Any]:
    return tomllib.loads((data_folder("recipes") / "sensors" / "bayer_rgb.toml").read_text())


def _damaged_trajectory(content: list[dict[str, Any]], dice: random.Random) -> bytes:
    return _as_damaged_json(dice.choice(content), dice)


def _blender(root: Path) -> dict[str, Any]:
    _pixels(root, [f"train/r_{i}.png" for i in range(4)])
    frames = [
        {"file_path": f"./train/r_{i}", "rotation": 0.1, "transform_matrix": (pose @ OPENCV_TO_OPENGL).tolist()}
        for i, pose in enumerate(ring(4))
    ]
    return {"camera_angle_x": 0.8, "w": 48.0, "h": 36.0, "frames": frames}


def _colmap(root: Path) -> dict[str, str]:
    """The files of a model by name, a rig of two sensors."""
    names = [f"{folder}/{i:04d}.png" for folder in ("rgb", "nir") for i in range(3)]
    _pixels(root / "images", names)
    lines = []
    for i, (name, pose) in enumerate(zip(names, ring(3) * 2, strict=True), 1):
        there = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(there[:3, :3]).as_quat()
        lines.append(" ".join(map(str, (i, w, x, y, z, *there[:3, 3], 1 + i // 4, name))) + "\n1.5 2.5 -1")
    frames = [f"{i} 1 1 0 0 0 0 0 0 2 CAMERA 1 {i} CAMERA 2 {i + 3}" for i in range(1, 4)]
    return {
        "cameras.txt": "1 OPENCV 24 18 25 26 12 9 0.1 0.2 0 0\n2 OPENCV_FISHEYE 24 18 25 26 12 9 0 0 0 0",
        "images.txt": "\n".join(lines),
        "frames.txt": "\n".join(frames),
        "points3D.txt": "\n".join(f"{i} 0.{i} 0 0 1 2 3 0.5 1 0 2 0 3 0" for i in range(9)),
    }


def _damaged_model(content: dict[str, str], dice: random.Random) -> bytes:
    """All of the files, one of them damaged."""
    chosen = dice.choice(list(content))
    return b"\0".join(_damaged_text(text, dice) if name == chosen else text.encode() for name, text in content.items())


def _load_model(path: Path) -> object:
    parts = path.read_bytes().split(b"\0")
    for name, text in zip(("cameras.txt", "images.txt", "frames.txt", "points3D.txt"), parts, strict=False):
        (path.parent / name).write_bytes(text)
    return load_scene(path.parent, layout="colmap")


def _colmap_binary(root: Path) -> bytes:
    """Two files as one, cut where the first ends."""
    _pixels(root, [f"{i:04d}.png" for i in range(4)])
    cameras = struct.pack("<QIiQQ8d", 1, 7, 4, 24, 18, 25.0, 26.0, 12.0, 9.0, 0.1, 0.2, 0.0, 0.0)
    images = [struct.pack("<Q", 4)]
    for i, pose in enumerate(ring(4)):
        there = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(there[:3, :3]).as_quat()
        images.append(
            struct.pack("<I7dI", i, w, x, y, z, *there[:3, 3], 7) + f"{i:04d}.png\0".encode() + struct.pack("<Q2dq", 1, 1.0, 2.0, -1)
        )
    return cameras + b"".join(images)


def _damaged_bytes(content: bytes, dice: random.Random) -> bytes:
    """Bytes replaced, or the end cut off."""
    damaged = bytearray(content)
    for _ in range(dice.choice((1, 1, 2, 8))):
        damaged[dice.randrange(len(damaged))] = dice.choice((0, 1, 255, dice.randrange(256)))
    return bytes(damaged[: dice.randrange(len(damaged))] if dice.random() < 0.3 else damaged)


def _load_binary(path: Path) -> object:
    data, size = path.read_bytes(), struct.calcsize("<QIiQQ8d")
    (path.parent / "cameras.bin").write_bytes(data[:size])
    (path.parent / "images.bin").write_bytes(data[size:])
    return load_scene(path.parent)


def _scene_toml(root: Path) -> dict[str, Any]:
    (root / "transforms.json").write_text(json.dumps(_transforms(root)))
    _pixels(root / "nir", [f"{i:04d}.png" for i in range(4)])
    return {"layout": "nerfstudio", "images": "images", "also": {"nir": "nir"}}


def _neus(root: Path) -> dict[str, Any]:
    _pixels(root / "image", [f"{i:03d}.png" for i in range(4)])
    matrix = np.array([[25.0, 0, 11.7, 0], [0, 26.0, 8.4, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    worlds = {f"world_mat_{i}": (matrix @ np.linalg.inv(pose)).tolist() for i, pose in enumerate(ring(4))}
    return worlds | {f"scale_mat_{i}": np.eye(4).tolist() for i in range(4)}


def _damaged_npz(content: Any, dice: random.Random) -> bytes:
    """Arrays of any shape and type, or bytes that are no archive."""
    damaged = _damage(content, dice)
    stream = io.BytesIO()
    try:
        np.savez(stream, **{str(key): np.asarray(value) for key, value in damaged.items()})
    except (ValueError, OverflowError, TypeError, AttributeError):
        np.savez(stream, world_mat_0=np.eye(3))
    data = stream.getvalue()
    return data[: dice.randrange(len(data))] if dice.random() < 0.1 else data


def _load_folder(path: Path) -> object:
    return load_scene(path.parent)


# file: how many mutations, what it is made of (given the folder), how it is damaged, how it is read (given the file)
_Case = tuple[int, Callable[[Path], Any], Callable[[Any, random.Random], bytes], Callable[[Path], object]]
CASES: dict[str, _Case] = {
    "meta_data.json": (600, _mmsdata, _as_damaged_json, _load_folder),
    "poses/meta_data.json": (150, _mmsdata, _as_damaged_json, read_poses),
    "transforms.json": (450, _transforms, _as_damaged_json, _load_folder),
    "poses/transforms.json": (200, _transforms, _as_damaged_json, read_poses),
    "camera_path.json": (200, lambda root: _camera_path(), _as_damaged_json, read_poses),
    "poses.json": (120, lambda root: _rig(), _as_damaged_json, read_poses),
    "trajectory.json": (200, lambda root: _TRAJECTORIES, _damaged_trajectory, _trajectory),
    "toy_par.txt": (200, _par, _damaged_text, _load_folder),
    "transforms_train.json": (200, _blender, _as_damaged_json, _load_folder),
    "model.files": (150, _colmap, _damaged_model, _load_model),
    "model.bytes": (150, lambda root: _colmap_binary(root), _damaged_bytes, _load_binary),
    "cameras_sphere.npz": (150, _neus, _damaged_npz, _load_folder),
    "scene.toml": (100, _scene_toml, _as_damaged_toml, _load_folder),
    "images.txt": (200, lambda root: _COLMAP, _damaged_text, read_poses),
    "cameras.txt": (150, _cameras, _damaged_text, lambda path: read_poses(path.parent)),
    "path.tum": (150, lambda root: _TUM, _damaged_text, read_poses),
    "sensor.toml": (300, lambda root: _sensor(), _as_damaged_toml, load_sensor),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", CASES)
def test_damaged_metadata_is_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    count, make, damage, read = CASES[name]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    content = make(path.parent)
    dice = random.Random(name)
    refused = 0
    for index in range(count):
        path.write_bytes(damage(content, dice))
        try:
            read(path)
        except InputError as error:
            refused += 1
            said = str(error)
            assert said.endswith(".") and "\n" not in said and str(tmp_path) in said, f"mutation {index} of {name}: {said}"
        except Exception as error:
            raise AssertionError(f"mutation {index} of {name}: {path.read_bytes()[:3000]!r}") from error
    assert refused > count / 5


def test_two_thousand_mutations() -> None:
    assert sum(case[0] for case in CASES.values()) >= 2000
