"""The reader of COLMAP scenes, against pycolmap and against models written here as text."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import look_at, ring
from scipy.spatial.transform import Rotation

from mmsynth.errors import InputError
from mmsynth.scene.layouts import colmap_model
from mmsynth.scene.layouts.colmap_model import read_model, read_points
from mmsynth.scene.load import load_scene, read_poses, sparse_points
from mmsynth.sensors.camera import project

SIZE = (24, 18)
LENSES = {
    "SIMPLE_PINHOLE": [25.0, 12.2, 8.9],
    "PINHOLE": [25.0, 26.0, 12.2, 8.9],
    "SIMPLE_RADIAL": [25.0, 12.2, 8.9, -0.1],
    "RADIAL": [25.0, 12.2, 8.9, -0.1, 0.05],
    "OPENCV": [25.0, 26.0, 12.2, 8.9, -0.1, 0.05, 0.01, -0.02],
    "FULL_OPENCV": [25.0, 26.0, 12.2, 8.9, -0.1, 0.05, 0.01, -0.02, 0.003, 0.01, -0.02, 0.004],
    "OPENCV_FISHEYE": [25.0, 26.0, 12.2, 8.9, -0.02, 0.01, 0.003, -0.001],
    "SIMPLE_RADIAL_FISHEYE": [25.0, 12.2, 8.9, -0.02],
    "RADIAL_FISHEYE": [25.0, 12.2, 8.9, -0.02, 0.01],
    "SIMPLE_FISHEYE": [25.0, 12.2, 8.9],
    "FISHEYE": [25.0, 26.0, 12.2, 8.9],
}
OTHERS = {
    "FOV": [25.0, 26.0, 12.2, 8.9, 0.5],
    "THIN_PRISM_FISHEYE": [25.0, 26.0, 12.2, 8.9, *[0.01] * 8],
    "RAD_TAN_THIN_PRISM_FISHEYE": [25.0, 26.0, 12.2, 8.9, *[0.01] * 12],
    "EUCM": [25.0, 26.0, 12.2, 8.9, 0.5, 1.0],
}


def picture(file: Path, size: tuple[int, int] = SIZE) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8))


def model(
    folder: Path,
    names: Sequence[str] = tuple(f"{i:04d}.png" for i in range(5)),
    poses: Sequence[np.ndarray] | None = None,
    cameras: Sequence[int] | None = None,
    size: tuple[int, int] = SIZE,
    lens: str = "OPENCV",
    points: int = 0,
) -> Path:
    """A model as text: image i is called names[i] and has the camera cameras[i]."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = cameras or [1] * len(names)
    numbers = " ".join(map(str, {**LENSES, **OTHERS}[lens]))
    (folder / "cameras.txt").write_text("".join(f"{i} {lens} {size[0]} {size[1]} {numbers}\n" for i in sorted(set(cameras))))
    lines = []
    for index, (name, pose) in enumerate(zip(names, poses if poses is not None else ring(len(names)), strict=True)):
        there = np.linalg.inv(pose)
        x, y, z, w = Rotation.from_matrix(there[:3, :3]).as_quat()
        values = " ".join(f"{value:.15g}" for value in (w, x, y, z, *there[:3, 3]))
        lines.append(f"{index + 1} {values} {cameras[index]} {name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    cloud = np.random.default_rng(0).normal(size=(points, 3)) * 0.1
    (folder / "points3D.txt").write_text("".join(f"{i} {x} {y} {z} 0 0 0 1 1 0 2 0 3 0\n" for i, (x, y, z) in enumerate(cloud)))
    return folder


def scene_folder(root: Path, place: str = "sparse/0", **options) -> Path:  # type: ignore[no-untyped-def]
    listed = colmap_model.read_model(model(root / place, **options))
    for image in listed:
        picture(root / "images" / image.name)
    return root


# --- against pycolmap


def synthetic(tmp_path: Path, cameras: int = 1, lens: str = "SIMPLE_RADIAL", text: bool = False):  # type: ignore[no-untyped-def]
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, cameras, 6, 120
    options.camera_model_id = getattr(pycolmap.CameraModelId, lens)
    options.camera_params = {**LENSES, **OTHERS}[lens]
    options.camera_width, options.camera_height = SIZE
    made = pycolmap.synthesize_dataset(options)
    for image in made.images.values():
        rig, instant = image.name.split("_")
        image.name = f"{rig}/{instant}" if cameras > 1 else image.name
        picture(tmp_path / "images" / image.name)
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (made.write_text if text else made.write_binary)(folder)
    return made


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_pixels_are_those_of_pycolmap(tmp_path: Path, lens: str, text: bool) -> None:
    made = synthetic(tmp_path, lens=lens, text=text)
    images = {image.name: image for image in made.images.values()}
    points = np.array([point.xyz for point in made.points3D.values()])
    read = read_model(tmp_path / "sparse" / "0")
    assert sorted(images) == [image.name for image in read]
    for image in read:
        theirs = images[image.name]
        to_camera = np.linalg.inv(image.camera_to_world)
        local = points @ to_camera[:3, :3].T + to_camera[:3, 3]
        near = (local[:, 2] > 0) & (np.linalg.norm(local[:, :2], axis=1) < 0.5 * local[:, 2])
        expected = [theirs.project_point(point) for point in points[near]]
        assert image.camera is not None and near.sum() > 10
        np.testing.assert_allclose(project(local[near], image.camera) + 0.5, expected, atol=1e-8)
    cloud = read_points(tmp_path / "sparse" / "0")
    assert cloud is not None
    np.testing.assert_allclose(np.sort(cloud.positions, 0), np.sort(points, 0), atol=1e-12)
    np.testing.assert_array_equal(np.sort(cloud.colours, 0), np.sort([point.color for point in made.points3D.values()], 0))


@pytest.mark.parametrize("lens", OTHERS)
@pytest.mark.parametrize("text", [False, True])
def test_other_lenses_are_named(tmp_path: Path, lens: str, text: bool) -> None:
    synthetic(tmp_path, lens=lens, text=text)
    with pytest.raises(InputError, match=rf"unsupported camera {lens}, expected one of"):
        load_scene(tmp_path)


@pytest.mark.parametrize("text", [False, True])
def test_rigs_and_frames(tmp_path: Path, text: bool) -> None:
    """Three cameras on a rig: one view per frame, a constant place on the rig."""
    made = synthetic(tmp_path, cameras=3, text=text)
    scene = load_scene(tmp_path)
    assert len(scene.sensors) == 3 and len(scene.frames) == 18 and len({frame.view for frame in scene.frames}) == 6
    by_name = {image.name: image.frame_id for image in made.images.values()}
    for view in range(6):
        frames = [by_name[frame.path.relative_to(tmp_path / "images").as_posix()] for frame in scene.frames if frame.view == view]
        assert len(set(frames)) == 1 and len(frames) == 3
    first, *others = scene.sensors
    for other in others:
        pairs = zip(scene.frames_of(first), scene.frames_of(other), strict=True)
        places = [np.linalg.inv(one.camera_to_world) @ two.camera_to_world for one, two in pairs]
        np.testing.assert_allclose(places, [places[0]] * 6, atol=1e-9)


def test_binary_that_ends_early_is_refused(tmp_path: Path) -> None:
    synthetic(tmp_path, cameras=2)
    folder = tmp_path / "sparse" / "0"
    for name in ("cameras.bin", "images.bin", "points3D.bin", "frames.bin"):
        data = (folder / name).read_bytes()
        for length in range(0, len(data), max(1, len(data) // 40)):
            (folder / name).write_bytes(data[:length])
            with pytest.raises(InputError, match=rf"{name}: truncated at byte {length}"):
                load_scene(tmp_path)
        (folder / name).write_bytes(data)


# --- the same without pycolmap


def test_binary_as_the_format_says(tmp_path: Path) -> None:
    """One camera, one image, by the description of the format alone."""
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 7, 1, 24, 18, 25.0, 26.0, 12.5, 9.5))
    image = struct.pack("<QI7dI", 1, 3, 0.0, 1.0, 0.0, 0.0, 1.0, 2.0, 3.0, 7) + b"a/b.png\0" + struct.pack("<Q2dq", 1, 1.0, 2.0, -1)
    (tmp_path / "images.bin").write_bytes(image)
    (one,) = read_model(tmp_path)
    assert one.name == "a/b.png" and one.camera is not None
    np.testing.assert_array_equal(one.camera.intrinsics, [25, 26, 12, 9])
    np.testing.assert_allclose(one.camera_to_world[:3], [[1, 0, 0, -1], [0, -1, 0, 2], [0, 0, -1, 3]], atol=1e-12)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QIiQQ", 1, 7, 42, 24, 18))
    with pytest.raises(InputError, match="camera 7: unsupported camera number 42"):
        read_model(tmp_path)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "dense/0/sparse", "dense/sparse", "colmap/sparse/0", "colmap", "."])
def test_places_of_a_model(tmp_path: Path, place: str) -> None:
    scene = load_scene(scene_folder(tmp_path, place))
    assert scene.format == "COLMAP" and len(scene.frames) == 5 and scene.problems == ()
    for frame, pose in zip(scene.frames, ring(5), strict=True):
        np.testing.assert_allclose(frame.camera_to_world, pose, atol=1e-9)


@pytest.mark.parametrize("pictures", ["dense/0/images", "dense/0", "images", "."])
def test_pictures_beside_or_above_the_model(tmp_path: Path, pictures: str) -> None:
    scene_folder(tmp_path, "dense/0/sparse")
    shutil.move(tmp_path / "images", tmp_path / "moved")
    (tmp_path / pictures).mkdir(exist_ok=True)
    for file in (tmp_path / "moved").iterdir():
        shutil.move(file, tmp_path / pictures / file.name)
    assert len(load_scene(tmp_path).frames) == 5


def test_the_model_with_most_pictures(tmp_path: Path) -> None:
    scene_folder(tmp_path, "sparse/0", names=[f"{i:04d}.png" for i in range(3)])
    model(tmp_path / "sparse" / "1")
    for i in range(5):
        picture(tmp_path / "images" / f"{i:04d}.png")
    scene = load_scene(tmp_path)
    assert len(scene.frames) == 5 and any("the model of 5 pictures; there are others" in text for text in scene.problems)


def test_model_of_larger_pictures_that_are_not_there(tmp_path: Path) -> None:
    """sparse/0 is the lens model of the originals, dense/0 that of the pictures: cut to other sides by undistortion."""
    model(tmp_path / "sparse" / "0", size=(73, 50), lens="SIMPLE_RADIAL")
    scene_folder(tmp_path, "dense/0/sparse", lens="PINHOLE")
    scene = load_scene(tmp_path)
    assert scene.frames[0].camera.distortion == () and any(
        text.startswith("dense/0/sparse is read, and not sparse/0: ") for text in scene.problems
    )
    shutil.rmtree(tmp_path / "dense")
    with pytest.raises(InputError, match=r"0000\.png: the picture is 24x18 pixels, expected 73x50 .* by one ratio"):
        load_scene(tmp_path)


def test_model_of_another_size_is_scaled(tmp_path: Path) -> None:
    scene_folder(tmp_path, size=(97, 72))  # a quarter, rounded
    scene = load_scene(tmp_path)
    camera = scene.frames[0].camera
    assert (camera.width, camera.height) == SIZE and camera.fx == pytest.approx(25 * 24 / 97) and camera.fy == pytest.approx(26 / 4)
    assert camera.cx + 0.5 == pytest.approx(12.2 * 24 / 97)
    assert scene.problems == ("sparse/0: 5 pictures have 0.2474 times the size that it states; their cameras are scaled.",)


def test_what_has_no_partner_is_left_out(tmp_path: Path) -> None:
    scene_folder(tmp_path)
    (tmp_path / "images" / "0001.png").unlink()
    picture(tmp_path / "images" / "0002.png", (18, 24))  # turned
    picture(tmp_path / "images" / "zzz.png")
    scene = load_scene(tmp_path)
    assert [frame.view for frame in scene.frames] == [0, 3, 4]
    said = "\n".join(scene.problems)
    assert (
        "1 of 5 images" in said and "1 pictures do not fit their cameras" in said and "1 pictures are not in" in said and "zzz.png" in said
    )


def test_one_camera_per_picture(tmp_path: Path) -> None:
    scene = load_scene(scene_folder(tmp_path, cameras=[5, 4, 3, 2, 1]))
    assert list(scene.sensors) == ["rgb"] and len(scene.frames) == 5


PLACE = np.eye(4)
PLACE[:3, :3], PLACE[:3, 3] = Rotation.from_euler("xyz", [2, -4, 90], degrees=True).as_matrix(), (0.1, 0.0, 0.05)


def folders(tmp_path: Path, second: Sequence[np.ndarray], cameras: Sequence[int]) -> Path:
    names = [f"{folder}/{i:04d}.png" for folder in ("rgb", "thermal") for i in range(4)]
    return scene_folder(tmp_path, names=names, poses=[*ring(4), *second], cameras=cameras)


def test_subfolders_are_sensors_of_a_rig(tmp_path: Path) -> None:
    scene = load_scene(folders(tmp_path, [pose @ PLACE for pose in ring(4)], [1] * 4 + [2] * 4))
    assert list(scene.sensors) == ["rgb", "thermal"]
    assert [frame.view for frame in scene.frames] == [0, 1, 2, 3] * 2
    assert any("taken as sensors of a rig" in text for text in scene.problems)
    assert list(load_scene(tmp_path, modalities=["thermal"]).sensors) == ["thermal"]


def test_a_sensor_without_files_and_one_that_is_listed_twice(tmp_path: Path) -> None:
    root = folders(tmp_path, [pose @ PLACE for pose in ring(4)], [1] * 4 + [2] * 4)
    shutil.rmtree(root / "images" / "thermal")
    scene = load_scene(root)
    assert len(scene.frames) == 4 and any("4 of 8 images" in text for text in scene.problems)
    names = ["rgb/0.png", "rgb/0.webp", "rgb/1.png", "nir/0.png", "nir/1.png"]
    one, two, _ = ring(3)
    poses = [one, one, two, one, two]
    with pytest.raises(InputError, match="2 images of the sensor 'rgb' are of one instant, 0, expected one"):
        load_scene(scene_folder(tmp_path / "twice", names=names, poses=poses, cameras=[1, 1, 1, 2, 2]))


def test_subfolders_of_one_camera_or_of_two_walks_are_no_rig(tmp_path: Path) -> None:
    """The same names in two folders say nothing when the cameras are one, or turn against each other."""
    one = load_scene(folders(tmp_path / "one", [pose @ PLACE for pose in ring(4)], [1] * 8))
    walks = load_scene(folders(tmp_path / "walks", [look_at(p) for p in ((3, 0, 1), (2, 2, 2), (3, 0, 2), (0, 3, -1))], [1] * 4 + [2] * 4))
    for scene in (one, walks):
        assert list(scene.sensors) == ["rgb"] and len({frame.view for frame in scene.frames}) == 8


def test_sparse_points_give_the_region(tmp_path: Path) -> None:
    scene_folder(tmp_path, points=400)
    scene = load_scene(tmp_path)
    region, points = scene.region, sparse_points(scene)
    assert points is not None and points.positions.shape == points.colours.shape == (400, 3)
    assert np.linalg.norm(region.centre) < 0.05 and 0.2 < region.radius < 0.5


def test_pictures_elsewhere(tmp_path: Path) -> None:
    scene_folder(tmp_path)
    (tmp_path / "images_2").mkdir()
    for i in range(5):
        picture(tmp_path / "images_2" / f"{i:04d}.webp", (12, 9))
    scene = load_scene(tmp_path, images="images_2")
    assert {frame.path.suffix for frame in scene.frames} == {".webp"} and scene.frames[0].camera.width == 12
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(InputError, match=r"none of its 5 images has a file in .*--images FOLDER"):
        load_scene(tmp_path)


def test_poses_of_either_file(tmp_path: Path) -> None:
    model(tmp_path)
    for path in (tmp_path, tmp_path / "images.txt"):
        assert [pose.name for pose in read_poses(path)] == [f"{i:04d}" for i in range(5)]
