"""COLMAP's model as it is written, against pycolmap."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mmsynth.scene.layouts.colmap_writer import colmap_files, rig_of
from mmsynth.scene.points import SparsePoints
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera, project

pycolmap = pytest.importorskip("pycolmap")

unit = st.floats(-1.0, 1.0)


@st.composite
def poses(draw: Any, far: float = 1e3) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([np.pi * draw(unit) for _ in range(3)]).as_matrix()
    pose[:3, 3] = [far * draw(unit) for _ in range(3)]
    return pose


@st.composite
def cameras(draw: Any) -> Camera:
    count, fisheye = draw(st.sampled_from([(0, False), (4, False), (5, False), (6, False), (8, False), (0, True), (4, True)]))
    width, height = draw(st.integers(16, 9000)), draw(st.integers(16, 9000))
    focal = width * draw(st.floats(0.6, 3.0))
    lens = tuple(0.02 * draw(unit) for _ in range(count))
    centre = (width / 2 + 10 * draw(unit), height / 2 + 10 * draw(unit))
    return Camera(width, height, focal, focal * draw(st.floats(0.9, 1.1)), *centre, lens, "kannala_brandt" if fisheye else "brown_conrady")


def written(folder: Path, *given: Any) -> Any:
    for name, content in colmap_files(*given).items():
        (folder / name).write_bytes(content)
    return pycolmap.Reconstruction(str(folder))


def world_to_camera(image: Any) -> np.ndarray:
    return np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])


def check(found: Any, images: dict[str, dict[int, PosedCamera]]) -> None:
    """Every image is there; its pose to 1e-9 of its distance, its intrinsics exactly, and points lie where they are seen."""
    at = {image.name: image for image in found.images.values()}
    expected = [posed for own in images.values() for posed in own.values()]
    assert sorted(at) == sorted(posed.name for posed in expected)
    points = np.random.default_rng(0).uniform([-0.3, -0.3, 1.0], [0.3, 0.3, 4.0], (50, 3))
    for posed in expected:
        image = at[posed.name]
        pose, far = world_to_camera(image), max(1.0, float(np.abs(posed.camera_to_world[:3, 3]).max()))
        np.testing.assert_allclose(pose[:3, :3], posed.camera_to_world[:3, :3].T, atol=1e-9)
        np.testing.assert_allclose(np.linalg.inv(pose)[:3, 3], posed.camera_to_world[:3, 3], atol=1e-9 * far)
        camera = found.cameras[image.camera_id]
        assert (camera.width, camera.height) == (posed.camera.width, posed.camera.height)
        np.testing.assert_array_equal(camera.calibration_matrix()[[0, 1, 0, 1], [0, 1, 2, 2]], posed.camera.intrinsics + [0, 0, 0.5, 0.5])
        seen = np.array([camera.img_from_cam(point) for point in points]) - 0.5
        ours = project(points, posed.camera)
        assert np.isfinite(ours).all() and np.abs(seen - ours).max() < 1e-6  # pixels


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(camera=cameras(), placed=st.lists(poses(), min_size=1, max_size=4))
def test_one_sensor(tmp_path: Path, camera: Camera, placed: list[np.ndarray]) -> None:
    images = {"rgb": {view: PosedCamera(camera, pose, f"{view}.png") for view, pose in enumerate(placed)}}
    found = written(tmp_path, images)
    check(found, images)
    assert len(found.rigs) == 1 and len(found.frames) == len(placed)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    lenses=st.tuples(cameras(), cameras(), cameras()),
    of_rig=st.lists(poses(), min_size=2, max_size=4),
    places=st.tuples(poses(1), poses(1)),
)
def test_a_rig(tmp_path: Path, lenses: tuple[Camera, ...], of_rig: list[np.ndarray], places: tuple[np.ndarray, ...]) -> None:
    """A sensor that shares no view with the reference, but one with another sensor, is on the rig, too."""
    names = ("rgb", "nir", "pol")
    views = (range(len(of_rig) - 1), range(len(of_rig)), [len(of_rig) - 1])
    images = {
        name: {view: PosedCamera(camera, of_rig[view] @ place, f"{name}/{view}.png") for view in own}
        for name, camera, place, own in zip(names, lenses, (np.eye(4), *places), views, strict=True)
    }
    found = written(tmp_path, images)
    check(found, images)
    assert len(found.rigs) == 1 and len(found.frames) == len(of_rig)
    (rig,) = found.rigs.values()
    assert rig.num_sensors() == 3
    for frame in found.frames.values():
        of_frame = {found.images[data.id].name.split("/")[1] for data in frame.data_ids}
        assert len(of_frame) == 1


@pytest.mark.parametrize("far", [0.0, 1.0, 1e3, 1e7])
def test_a_rig_that_only_turns_far_from_the_origin(tmp_path: Path, far: float) -> None:
    """There is no extent to measure rounding by."""
    camera, turned = Camera(16, 16, 16.0, 16.0, 8.0, 8.0), np.eye(4)
    turned[:3, 3] = 0.3 * far, -far, 0.7 * far
    of_rig = {0: turned, 1: turned.copy(), 2: turned.copy()}
    for view, pose in of_rig.items():
        pose[:3, :3] = Rotation.from_rotvec([0.3, -0.7 * view, 0.2]).as_matrix()
    images = {name: {view: PosedCamera(camera, of_rig[view], f"{name}/{view}.png") for view in of_rig} for name in ("rgb", "nir")}
    assert len(written(tmp_path, images).rigs) == 1
    images["nir"][1] = PosedCamera(camera, of_rig[1].copy(), "nir/1.png")
    of_rig[1][:3, 3] += 1e-6 * max(far, 1.0)
    assert len(written(tmp_path, images).rigs) == 2


def test_sensors_that_stand_loose_are_no_rig(tmp_path: Path) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.0, 23.0)
    place, loose = np.eye(4), np.eye(4)
    place[0, 3], loose[0, 3] = 0.1, 0.1001
    at = lambda name, poses: {view: PosedCamera(camera, pose, f"{name}/{view}.png") for view, pose in enumerate(poses)}
    moved = np.eye(4)
    moved[2, 3] = 1.0
    images = {"rgb": at("rgb", [np.eye(4), moved]), "nir": at("nir", [place, moved @ loose])}
    assert rig_of(images) is None
    found = written(tmp_path, images)
    check(found, images)
    assert len(found.rigs) == 2 and len(found.frames) == 4
    # a camera of its own for a picture: COLMAP's rigs have one for each sensor
    zoomed = {"rgb": at("rgb", [np.eye(4), moved]), "nir": at("nir", [place, moved @ place])}
    assert rig_of(zoomed) is not None
    zoomed["nir"][1] = PosedCamera(Camera(64, 48, 61.0, 61.0, 31.0, 23.0), moved @ place, "nir/1.png")
    assert rig_of(zoomed) is None
    check(written(tmp_path, zoomed), zoomed)


def test_the_files_are_those_that_pycolmap_writes(tmp_path: Path) -> None:
    """Byte for byte, read and written by it: nothing that it understands in another way, nothing that it passes over."""
    random = np.random.default_rng(1)
    placed = []
    for _ in range(3):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.random(rng=random).as_matrix(), random.normal(size=3)
        placed.append(pose)
    offset = np.eye(4)
    offset[:3, 3] = 0.1, -0.2, 0.3
    cameras = (Camera(64, 48, 60.0, 61.0, 31.0, 23.0, (0.1, 0.0, 0.01, 0.0)), Camera(60, 40, 60.0, 61.0, 31.0, 23.0))
    images = {
        name: {view: PosedCamera(camera, pose @ place, f"{name}/{view}.png") for view, pose in enumerate(placed)}
        for name, camera, place in zip(("rgb", "ms"), cameras, (np.eye(4), offset), strict=True)
    }
    points = SparsePoints(random.normal(size=(7, 3)), random.integers(0, 256, (7, 3), dtype=np.uint8))
    found = written(tmp_path, images, points)
    np.testing.assert_array_equal([found.points3D[i + 1].xyz for i in range(7)], points.positions)
    np.testing.assert_array_equal([found.points3D[i + 1].color for i in range(7)], points.colours)
    (tmp_path / "again").mkdir()
    found.write_binary(str(tmp_path / "again"))
    again = {path.name: path.read_bytes() for path in (tmp_path / "again").iterdir()}
    ours = colmap_files(images, points)
    assert {name: len(content) for name, content in ours.items()} == {name: len(content) for name, content in again.items()}
    for name in ("cameras.bin", "rigs.bin", "frames.bin"):
        assert ours[name] == again[name], name
