"""Poses files, and rigidity."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import OPENCV_TO_OPENGL, ring
from scipy.spatial.transform import Rotation

from mmsynth.errors import InputError
from mmsynth.scene.checks import rigid_pose
from mmsynth.scene.load import load_scene, read_poses
from mmsynth.sensors.camera import Camera, project

CAMERA = Camera(24, 18, 25.0, 25.0, 11.5, 8.5)


def write_colmap(folder: Path, poses: list[np.ndarray], points: str = "\n") -> Path:
    lines = ["# id qw qx qy qz tx ty tz camera name"]
    for index, pose in enumerate(poses):
        to_camera = np.linalg.inv(pose)
        w, x, y, z = quaternion(to_camera[:3, :3])
        tx, ty, tz = to_camera[:3, 3]
        lines.append(f"{index + 1} {w} {x} {y} {z} {tx} {ty} {tz} 7 rgb/{index:04d}.png{points}".rstrip(" "))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder / "images.txt"


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion as the eigenvector of Bar-Itzhack's matrix: independent of the formula under test."""
    r = rotation
    matrix = np.array([
        [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
        [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
    ])  # fmt: skip
    return np.linalg.eigh(matrix)[1][:, -1]


@pytest.mark.parametrize("points", ["\n", "\n1.5 2.5 -1 3.5 4.5 12", ""], ids=["empty line", "points", "no line"])
def test_colmap(tmp_path: Path, points: str) -> None:
    poses = ring(3)
    path = write_colmap(tmp_path, poses, points)
    assert [stated.camera for stated in read_poses(path)] == [None] * 3
    (tmp_path / "cameras.txt").write_text("# cameras\n7 FULL_OPENCV 24 18 25 26 12 9 .1 .2 .3 .4 .5 .6 .7 .8\n")
    found = read_poses(tmp_path)
    assert [stated.name for stated in found] == ["0000", "0001", "0002"]
    for stated, expected in zip(found, poses, strict=True):
        assert stated.camera == Camera(24, 18, 25.0, 26.0, 11.5, 8.5, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8))
        np.testing.assert_allclose(stated.camera_to_world, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 1 0 0 nan 0 0 0 7 a.png", "not finite"),
        ("1 2 0 0 0 0 0 0 7 a.png", "length 2"),
        ("1 1 0 0 0 0 0 x 7 a.png", "not a number"),
        ("1 1 0 0 0 0 0 0", "8 values"),
    ],
)
def test_colmap_errors_name_the_line(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "images.txt").write_text(f"# comment\n{line}\n\n")
    with pytest.raises(InputError, match=rf"images\.txt: line 2: .*{message}"):
        read_poses(tmp_path / "images.txt")


def test_colmap_fisheye(tmp_path: Path) -> None:
    write_colmap(tmp_path, ring(2))
    (tmp_path / "cameras.txt").write_text("7 OPENCV_FISHEYE 24 18 25 26 12 9 0.1 0.2 0 -0.01\n")
    assert read_poses(tmp_path)[0].camera == Camera(24, 18, 25.0, 26.0, 11.5, 8.5, (0.1, 0.2, 0.0, -0.01), "kannala_brandt")
    (tmp_path / "cameras.txt").write_text("7 OPENCV_FISHEYE 24 18 25 26 12 9 0 0 0 0\n")
    assert read_poses(tmp_path)[0].camera == Camera(24, 18, 25.0, 26.0, 11.5, 8.5, (), "kannala_brandt")


def test_another_colmap_camera_is_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path, ring(2))
    (tmp_path / "cameras.txt").write_text("7 THIN_PRISM_FISHEYE 24 18 25 26 12 9 0 0 0 0 0 0 0 0\n")
    with pytest.raises(InputError, match=r"cameras\.txt: line 1"):
        read_poses(tmp_path)


def tum_line(pose: np.ndarray, time: str) -> str:
    numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]  # SciPy's order is TUM's: x y z w
    return " ".join([time, *(repr(float(n)) for n in numbers)])


@pytest.mark.parametrize("name", ["groundtruth.txt", "path.tum"])
def test_tum(tmp_path: Path, name: str) -> None:
    poses = ring(3)
    lines = ["# ground truth", "# timestamp tx ty tz qx qy qz qw", *(tum_line(p, f"1305031102.{i}75") for i, p in enumerate(poses)), ""]
    (tmp_path / name).write_text("\n".join(lines))
    found = read_poses(tmp_path / name)
    assert [stated.name for stated in found] == ["1305031102.075", "1305031102.175", "1305031102.275"]
    for stated, expected in zip(found, poses, strict=True):
        assert stated.camera is None
        np.testing.assert_allclose(stated.camera_to_world, expected, atol=1e-12)


def test_colmap_under_another_name_is_not_tum(tmp_path: Path) -> None:
    path = write_colmap(tmp_path, ring(2)).rename(tmp_path / "poses.txt")
    for stated, expected in zip(read_poses(path), ring(2), strict=True):
        np.testing.assert_allclose(stated.camera_to_world, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0 0 0 0 0 1", "7 values, expected 't tx ty tz qx qy qz qw'"),
        ("1 0 0 0 0 0 0 x", "not a number, expected 't tx"),
        ("1 0 inf 0 0 0 0 1", "not finite"),
        ("1 0 0 0 0 0 0 0.5", "the quaternion has the length 0.5, expected a unit quaternion"),
    ],
)
def test_tum_errors_name_the_line(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "a.txt").write_text(f"# comment\n\n{line}\n")
    with pytest.raises(InputError, match=rf"a\.txt: line 3: .*{message}"):
        read_poses(tmp_path / "a.txt")


def test_tum_without_poses_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("# nothing yet\n")
    with pytest.raises(InputError, match=r"a\.tum: no poses in it"):
        read_poses(tmp_path / "a.tum")


def test_mmsdata_poses_are_those_of_the_scene(write_mmsdata: Callable[..., Path]) -> None:
    root = write_mmsdata((0, 2, 7))
    scene = load_scene(root)
    found = read_poses(root / "meta_data.json")
    assert [stated.name for stated in found] == ["0000", "0002", "0007"]
    for stated, frame in zip(found, scene.frames_of("rgb"), strict=True):
        assert stated.camera == frame.camera
        np.testing.assert_allclose(stated.camera_to_world, frame.camera_to_world, atol=1e-15)


def test_mmsdata_poses_need_no_images(write_mmsdata: Callable[..., Path]) -> None:
    root = write_mmsdata(range(3), lambda meta: meta["modalities"]["rgb"]["frames"].reverse())
    shutil.rmtree(root / "modalities")
    poses = [stated.camera_to_world for stated in read_poses(root / "meta_data.json")]
    # by frame id, turned by a quarter about z, scaled and moved to metres, as worldtogt says
    to_metres = np.array([[0.0, -0.25, 0.0, 0.1], [0.25, 0.0, 0.0, 0.2], [0.0, 0.0, 0.25, 0.3]])
    np.testing.assert_allclose([p[:3, 3] for p in poses], [to_metres @ p[:, 3] for p in ring(3)], atol=1e-12)


def spoil_pose(meta: dict[str, Any]) -> None:
    meta["modalities"]["rgb"]["frames"][1]["camtoworld"][0][0] = 3.0


def spoil_camera(meta: dict[str, Any]) -> None:
    del meta["modalities"]["rgb"]["fx"]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [(spoil_pose, "modality 'rgb', frame 1: the pose is not rigid"), (spoil_camera, "modality 'rgb': key 'fx' is missing")],
)
def test_mmsdata_poses_errors(write_mmsdata: Callable[..., Path], spoil: Callable[[dict[str, Any]], None], message: str) -> None:
    with pytest.raises(InputError, match=rf"meta_data\.json: {message}"):
        read_poses(write_mmsdata(range(2), spoil) / "meta_data.json")


def write_json(tmp_path: Path, content: Any) -> Path:
    (tmp_path / "poses.json").write_text(json.dumps(content))
    return tmp_path / "poses.json"


def test_transforms_as_poses(tmp_path: Path) -> None:
    frames = [{"file_path": f"out/{i}.png", "transform_matrix": (pose @ OPENCV_TO_OPENGL).tolist()} for i, pose in enumerate(ring(3))]
    for found, expected in zip(read_poses(write_json(tmp_path, {"frames": frames})), ring(3), strict=True):
        assert found.camera is None
        np.testing.assert_allclose(found.camera_to_world, expected, atol=1e-12)
    shared = {"fl_x": 25.0, "w": 24, "h": 18, "frames": frames}
    last = read_poses(write_json(tmp_path, shared))[2]
    assert (last.camera, last.name) == (CAMERA, "2")


def test_camera_path(tmp_path: Path) -> None:
    """The field of view is vertical, in degrees."""
    fov = np.degrees(2 * np.arctan(18 / 2 / 25.0))
    path = [{"camera_to_world": (pose @ OPENCV_TO_OPENGL).ravel().tolist(), "fov": fov, "aspect": 4 / 3} for pose in ring(2)]
    content = {"camera_type": "perspective", "render_width": 24, "render_height": 18, "camera_path": path}
    stated = read_poses(write_json(tmp_path, content))[1]
    camera, pose = stated.camera, stated.camera_to_world
    assert camera is not None and camera.fx == camera.fy == pytest.approx(25.0) and (camera.cx, camera.cy) == (11.5, 8.5)
    np.testing.assert_allclose(pose, ring(2)[1], atol=1e-12)
    # the upper edge of the frame is half a field of view above the axis, wide frames or not
    for width in (24, 60):
        camera = read_poses(write_json(tmp_path, content | {"render_width": width}))[0].camera
        assert camera is not None
        up = np.radians(fov / 2)
        across = np.tan(up) * width / 18
        edge = project(np.array([[0.0, -np.sin(up), np.cos(up)], [across, 0.0, 1.0]]), camera)
        np.testing.assert_allclose(edge, [[width / 2 - 0.5, -0.5], [width - 0.5, 8.5]], atol=1e-9)
        assert camera.distortion == ()
    content["camera_type"] = "equirectangular"
    with pytest.raises(InputError, match="equirectangular"):
        read_poses(write_json(tmp_path, content))


def test_rig(tmp_path: Path) -> None:
    content = {"convention": "OpenCV camera (x right, y down, z forward)", "rig": [pose.tolist() for pose in ring(2)]}
    np.testing.assert_allclose(read_poses(write_json(tmp_path, content))[1].camera_to_world, ring(2)[1], atol=1e-12)
    content["rig"][1][0][3] = float("nan")
    with pytest.raises(InputError, match=r"poses\.json: pose 1: .*not finite in row 0, column 3"):
        read_poses(write_json(tmp_path, content))
    content["convention"] = "OpenGL"
    with pytest.raises(InputError, match="expected OpenCV axes"):
        read_poses(write_json(tmp_path, content))


@pytest.mark.parametrize("content", [[], {}, {"frames": []}, {"frames": 3}, {"rig": {}}, {"camera_path": [{}]}])
def test_other_content_is_refused(tmp_path: Path, content: Any) -> None:
    with pytest.raises(InputError, match=r"poses\.json"):
        read_poses(write_json(tmp_path, content))


@pytest.mark.parametrize("bad", [None, "x", [[1, 2], [3]], np.eye(3), np.diag([1, 1, 1, 2.0]), [[None] * 4] * 3])
def test_rigid_refuses(bad: Any) -> None:
    with pytest.raises(InputError, match=r"^here: "):
        rigid_pose(bad, "here")
