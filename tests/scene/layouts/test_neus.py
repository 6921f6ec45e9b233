"""The reader of NeuS' and IDR's layout."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import ring
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mmsynth.errors import InputError
from mmsynth.scene.layouts.neus import _decomposed
from mmsynth.scene.load import load_scene
from mmsynth.sensors.camera import project

K = np.array([[30.0, 0, 11.2], [0, 31.0, 7.9], [0, 0, 1]])
SCALE = np.array([[250.0, 0, 0, 40], [0, 250, 0, -15], [0, 0, 250, 600], [0, 0, 0, 1]])


def write(
    root: Path, numbers: range = range(5), suffix: str = "png", masks: str | None = "mask", cameras: str = "cameras_sphere.npz"
) -> Path:
    """Cameras on a ring about the unit sphere, in a world of millimetres."""
    arrays = {}
    for number, pose in zip(numbers, ring(len(numbers)), strict=True):
        world = np.eye(4)
        world[:3] = 3.7 * K @ (np.linalg.inv(pose) @ np.linalg.inv(SCALE))[:3] * 250
        arrays |= {f"world_mat_{number}": world, f"scale_mat_{number}": SCALE}
    root.mkdir(exist_ok=True)
    np.savez(root / cameras, **arrays)
    for folder, name in [("image", "{:06d}"), *([(masks, "{:03d}")] if masks else [])]:
        (root / folder).mkdir(exist_ok=True)
        for number in numbers:
            values = np.random.default_rng(number).integers(0, 256, (16, 24, 3), np.uint8)
            cv2.imwrite(str(root / folder / f"{name.format(number)}.{suffix}"), values)
    return root


def test_pixels_are_p_of_the_points(tmp_path: Path) -> None:
    root = write(tmp_path)
    scene = load_scene(root)
    arrays = np.load(root / "cameras_sphere.npz")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
    for frame in scene.frames:
        matrix = arrays[f"world_mat_{frame.view}"] @ arrays[f"scale_mat_{frame.view}"]
        there = np.column_stack([points, np.ones(30)]) @ matrix[:3].T
        to_camera = np.linalg.inv(frame.camera_to_world)
        np.testing.assert_allclose(
            project(points @ to_camera[:3, :3].T + to_camera[:3, 3], frame.camera), there[:, :2] / there[:, 2:], atol=1e-9
        )
    assert scene.format == "NeuS" and scene.masks == "object" and scene.region.centre == (0.0, 0.0, 0.0) and scene.region.radius == 1.0
    assert [frame.mask.name for frame in scene.frames if frame.mask] == [f"{i:03d}.png" for i in range(5)]


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([1.0, -1.0, 1e-3, 250.0]))
def test_decomposition_gives_back_k_and_pose(seed: int, scale: float) -> None:
    """At any orientation of the camera, and whatever the scale and sign of P."""
    dice = np.random.default_rng(seed)
    rotation, centre = Rotation.random(rng=dice).as_matrix(), dice.normal(size=3)
    matrix = np.array(
        [[dice.uniform(100, 5000), 0, dice.uniform(-100, 3000)], [0, dice.uniform(100, 5000), dice.uniform(-100, 3000)], [0, 0, 1]]
    )
    intrinsics, pose = _decomposed(scale * matrix @ rotation @ np.column_stack([np.eye(3), -centre]), "x")
    np.testing.assert_allclose(intrinsics, matrix[[0, 1, 0, 1], [0, 1, 2, 2]], rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(pose, np.block([[rotation.T, centre[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]), atol=1e-9)


def test_fewer_pictures_than_cameras_go_by_their_numbers(tmp_path: Path) -> None:
    root = write(tmp_path)
    (root / "image" / "000001.png").unlink()
    scene = load_scene(root)
    assert [frame.view for frame in scene.frames] == [0, 2, 3, 4] and "1 of 5 cameras have no picture." in scene.problems
    assert [frame.mask.name for frame in scene.frames if frame.mask] == ["000.png", "002.png", "003.png", "004.png"]
    (root / "image" / "000002.png").rename(root / "image" / "left.png")
    with pytest.raises(InputError, match="4 pictures for 5 cameras"):
        load_scene(root)


def test_ids_that_begin_at_one_jpg_and_other_names_of_folders(tmp_path: Path) -> None:
    root = write(tmp_path, range(1, 6), "jpg", "masks", "cameras.npz")
    (root / "image").rename(root / "images")
    (root / "images" / ".DS_Store").write_text("")
    scene = load_scene(root)
    assert [frame.view for frame in scene.frames] == [1, 2, 3, 4, 5] and all(frame.mask for frame in scene.frames)


def test_without_masks(tmp_path: Path) -> None:
    assert all(frame.mask is None for frame in load_scene(write(tmp_path, masks=None)).frames)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda arrays: arrays.pop("scale_mat_2"), "array 'scale_mat_2' is missing"),
        (lambda arrays: arrays.update(world_mat_0=np.zeros((4, 4))), "world_mat_0: the projection is singular"),
        (lambda arrays: arrays.update(world_mat_1=np.eye(3)), r"'world_mat_1' is of shape \(3, 3\)"),
        (lambda arrays: arrays.update(world_mat_1=np.full((4, 4), np.nan)), "expected a finite 4x4"),
        (lambda arrays: arrays["world_mat_3"].__setitem__(0, arrays["world_mat_3"][0] + 0.1 * arrays["world_mat_3"][1]), "K has the skew"),
        (lambda arrays: arrays.clear(), "no array 'world_mat_0'"),
    ],
)
def test_bad_cameras_are_named(tmp_path: Path, change, said: str) -> None:  # type: ignore[no-untyped-def]
    root = write(tmp_path)
    arrays = dict(np.load(root / "cameras_sphere.npz"))
    change(arrays)
    np.savez(root / "cameras_sphere.npz", **arrays)
    with pytest.raises(InputError, match=said):
        load_scene(root)


def test_damaged_file(tmp_path: Path) -> None:
    root = write(tmp_path)
    data = (root / "cameras_sphere.npz").read_bytes()
    for length in (0, 10, len(data) // 2, len(data) - 5):
        (root / "cameras_sphere.npz").write_bytes(data[:length])
        with pytest.raises(InputError, match=r"cameras_sphere\.npz: damaged"):
            load_scene(root)
