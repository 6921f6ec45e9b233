"""The nerfstudio / instant-ngp reader, trap by trap."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from conftest import HEIGHT, WIDTH, frame_values, ring

from mmsynth.errors import InputError
from mmsynth.scene.image_writers import write_exr, write_npz
from mmsynth.scene.images import load_frame
from mmsynth.scene.layouts.nerfstudio import read_nerfstudio
from mmsynth.scene.scene import Region
from mmsynth.sensors.camera import project

Writer = Callable[..., Path]


def test_poses_and_half_pixel_agree_with_opencv(write_transforms: Writer) -> None:
    """COLMAP's pixel centres are at 0.5: what lies at its (x, y) lies at (x, y) - 0.5 here."""
    written: dict[str, Any] = {}
    scene = read_nerfstudio(write_transforms(edit=written.update))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
    matrix = np.array([[25.0, 0, 12.2], [0, 26.0, 8.9], [0, 0, 1]])
    for frame, item in zip(scene.frames, written["frames"], strict=True):
        to_camera = np.linalg.inv(np.array(item["transform_matrix"]) @ np.diag([1.0, -1, -1, 1]))
        rotation = cv2.Rodrigues(to_camera[:3, :3])[0]
        expected = cv2.projectPoints(points, rotation, to_camera[:3, 3], matrix, np.array([-0.12, 0.09, 0.01, -0.02]))[0][:, 0] - 0.5
        to_camera = np.linalg.inv(frame.camera_to_world)
        np.testing.assert_allclose(project(points @ to_camera[:3, :3].T + to_camera[:3, 3], frame.camera), expected, atol=1e-8)


def test_opengl_axes(write_transforms: Writer) -> None:
    for frame, pose in zip(read_nerfstudio(write_transforms()).frames, ring(4), strict=True):
        np.testing.assert_allclose(frame.camera_to_world, pose, atol=1e-12)


def test_sparse_points_of_the_file_give_the_region(write_transforms: Writer) -> None:
    plain = read_nerfstudio(write_transforms()).region
    path = write_transforms(edit=lambda meta: meta.update(ply_file_path="sparse_pc.ply"))
    missing = read_nerfstudio(path)
    assert missing.region == plain and "sparse_pc.ply" in missing.problems[-1]
    random = np.random.default_rng(0)
    points = np.concatenate([0.3 * random.uniform(-1, 1, (500, 3)), random.uniform(-9, 9, (500, 3)), np.full((3, 3), np.nan)])
    trimesh.PointCloud(points).export(path / "sparse_pc.ply")
    scene = read_nerfstudio(path)
    assert scene.region != plain and 0.3 < scene.region.radius < 0.7 and not scene.problems
    np.testing.assert_allclose(scene.region.centre, 0, atol=0.05)
    for broken in (b"", b"ply\nformat ascii 1.0\nelement vertex 9\n", random.bytes(200)):
        (path / "sparse_pc.ply").write_bytes(broken)
        scene = read_nerfstudio(path)
        assert scene.region == plain and "sparse_pc.ply" in scene.problems[-1], broken


def test_per_frame_intrinsics_win(write_transforms: Writer) -> None:
    def edit(meta: dict[str, Any]) -> None:
        meta["frames"][1].update(fl_x=31.0, cx=10.0, k1=0.25)
        meta["frames"][2].update(camera_angle_x=2 * np.arctan(WIDTH / 2 / 40.0))

    cameras = [frame.camera for frame in read_nerfstudio(write_transforms(edit=edit)).frames]
    assert (cameras[0].fx, cameras[0].cx, cameras[0].distortion[0]) == (25.0, 11.7, -0.12)
    assert (cameras[1].fx, cameras[1].cx, cameras[1].distortion[0]) == (31.0, 9.5, 0.25)
    assert (cameras[2].fx, cameras[2].fy) == (pytest.approx(40.0), pytest.approx(40.0))


def test_distortion_order(write_transforms: Writer) -> None:
    keys = {"k1": 0.1, "k2": 0.02, "k3": 0.003, "k4": 0.004, "k5": 0.005, "k6": 0.006, "p1": 0.07, "p2": 0.08}
    camera = read_nerfstudio(write_transforms(edit=lambda meta: meta.update(keys))).frames[0].camera
    assert camera.distortion == (0.1, 0.02, 0.07, 0.08, 0.003, 0.004, 0.005, 0.006)


def test_angle_only_and_no_extension(write_transforms: Writer) -> None:
    """The layout of synthetic NeRF scenes: camera_angle_x, size from the image, file_path without extension."""

    def edit(meta: dict[str, Any]) -> None:
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2"):
            del meta[key]
        meta["camera_angle_x"] = 2 * np.arctan(WIDTH / 2 / 25.0)
        for frame in meta["frames"]:
            frame["file_path"] = "./" + frame["file_path"][: -len(".png")]

    camera = read_nerfstudio(write_transforms(edit=edit)).frames[0].camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (WIDTH, HEIGHT, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    assert camera.fx == camera.fy == pytest.approx(25.0)
    assert camera.distortion == ()


def test_missing_images_are_counted_in_one_sentence(write_transforms: Writer) -> None:
    root = write_transforms(count=12)
    for view in (0, 4):
        (root / "images" / f"{view:04d}.png").unlink()
    scene = read_nerfstudio(root)
    assert scene.problems == ("2 of 12 frames have no image file and are left out.",)
    assert [frame.view for frame in scene.frames] == [1, 2, 3, 5, 6, 7, 8, 9, 10, 11]  # ids do not move up
    assert scene.split.test == (9,)


def test_no_image_at_all(write_transforms: Writer) -> None:
    with pytest.raises(InputError, match="none of the 4 frames has an image file"):
        read_nerfstudio(write_transforms(edit=lambda meta: [frame.update(file_path="x.png") for frame in meta["frames"]]))


def test_alpha_means_black_background(write_transforms: Writer) -> None:
    root = write_transforms()
    for view in range(4):
        rgba = (frame_values(view, 4) * 255).astype(np.uint8)
        cv2.imwrite(str(root / "images" / f"{view:04d}.png"), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
    scene = read_nerfstudio(root)
    assert scene.black_background is True and scene.sensors["rgb"].channels == ("R", "G", "B")
    pixels, alpha = load_frame(scene.sensors["rgb"], scene.frames[1])
    assert alpha is not None and pixels.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(alpha, frame_values(1, 4)[..., 3], atol=0.5 / 255 + 0.5 / 255)


def test_opaque_images_say_nothing_about_the_background(write_transforms: Writer) -> None:
    assert read_nerfstudio(write_transforms()).black_background is None


@pytest.mark.parametrize(
    ("keys", "test"),
    [
        ({"test_filenames": ["images/0001.png"]}, (1,)),
        ({"train_filenames": ["images/0001.png", "./images/0003.png"]}, (0, 2)),
        ({"test_ids": [2, 3]}, (2, 3)),
        ({}, (3,)),
    ],
)
def test_split(write_transforms: Writer, keys: dict[str, Any], test: tuple[int, ...]) -> None:
    assert read_nerfstudio(write_transforms(edit=lambda meta: meta.update(keys))).split.test == test


@pytest.mark.parametrize("keys", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_fisheyes_agree_with_opencv(write_transforms: Writer, keys: dict[str, Any]) -> None:
    lens = {"k1": -0.03, "k2": 0.01, "k3": -0.004, "k4": 0.0006}

    def edit(meta: dict[str, Any]) -> None:
        for entry in (meta, *meta["frames"]):
            for key in ("k1", "k2", "p1", "p2"):
                entry.pop(key, None)
        meta.update(keys | lens)

    camera = read_nerfstudio(write_transforms(edit=edit)).frames[0].camera
    points = np.random.default_rng(0).uniform((-2, -2, 0.5), (2, 2, 2), (30, 3))
    matrix = np.array([[25.0, 0, 12.2], [0, 26.0, 8.9], [0, 0, 1]])
    expected = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(list(lens.values())))[0][:, 0] - 0.5
    np.testing.assert_allclose(project(points, camera), expected, atol=1e-9)


def test_another_lens_is_refused(write_transforms: Writer) -> None:
    with pytest.raises(InputError, match="camera_model EQUIRECTANGULAR is not supported"):
        read_nerfstudio(write_transforms(edit=lambda meta: meta.update(camera_model="EQUIRECTANGULAR")))


def test_scaled_rotation_is_refused(write_transforms: Writer) -> None:
    def edit(meta: dict[str, Any]) -> None:
        meta["frames"][3]["transform_matrix"] = (np.array(meta["frames"][3]["transform_matrix"]) @ np.diag([2, 2, 2, 1])).tolist()

    with pytest.raises(InputError, match=r"transforms\.json: frame 3 \(images/0003\.png\): the pose is not rigid"):
        read_nerfstudio(write_transforms(edit=edit))


def test_no_focal_length(write_transforms: Writer) -> None:
    with pytest.raises(InputError, match="no focal length"):
        read_nerfstudio(write_transforms(edit=lambda meta: [meta.pop(key) for key in ("fl_x", "fl_y")]))


def test_several_modalities_in_one_file(write_transforms: Writer) -> None:
    """What generate-dataset writes: exr and npz frames with a modality and a view each."""

    def edit(meta: dict[str, Any]) -> None:
        frames = []
        for view, frame in enumerate(meta["frames"]):
            frames.append({**frame, "file_path": f"ms/{view}.exr", "modality": "multispectral", "view": view})
            frames.append({**frame, "file_path": f"pol/{view}.npz", "modality": "pol", "view": view})
        meta["frames"] = frames
        meta["modalities"] = {"ms": {"channels": ["a", "b"], "wavelengths_nm": [500, 600]}}

    root = write_transforms(edit=edit)
    for view in range(4):
        values = frame_values(view, 6) * 5
        write_exr(root / "ms" / f"{view}.exr", {"a": values[..., 0], "b": values[..., 1]})
        write_npz(root / "pol" / f"{view}.npz", {"data": values[..., 2:]})
    scene = read_nerfstudio(root)
    assert scene.sensors["ms"].channels == ("a", "b") and scene.sensors["ms"].wavelengths_nm == (500, 600)
    assert scene.sensors["pol"].polarizer_angles_deg == (0, 45, 90, 135)
    assert scene.black_background is None
    assert [frame.view for frame in scene.frames_of("pol")] == [0, 1, 2, 3]
    pixels, alpha = load_frame(scene.sensors["pol"], scene.frames_of("pol")[3])
    assert alpha is None
    np.testing.assert_array_equal(pixels, frame_values(3, 6)[..., 2:] * 5)
    assert list(read_nerfstudio(root, ["polarization"]).sensors) == ["pol"]


def test_another_file_name(write_transforms: Writer) -> None:
    root = write_transforms()
    (root / "transforms.json").rename(root / "transforms_val.json")
    assert len(read_nerfstudio(root / "transforms_val.json").frames) == 4


def test_broken_json(write_transforms: Writer) -> None:
    root = write_transforms()
    (root / "transforms.json").write_text(json.dumps({"frames": []})[:-2])
    with pytest.raises(InputError, match=r"transforms\.json: not valid JSON at line 1"):
        read_nerfstudio(root)


def test_a_stated_region_and_unit_are_taken(write_transforms: Writer) -> None:
    keys = {"region": {"centre": [0.1, 0.2, 0.3], "radius": 0.7}, "unit": "m"}
    scene = read_nerfstudio(write_transforms(edit=lambda meta: meta.update(keys)))
    assert (scene.region, scene.unit) == (Region((0.1, 0.2, 0.3), 0.7), "m")
    for wrong in (3, {}, {"centre": [0, 0], "radius": 1}, {"centre": [0, 0, 0]}, {"centre": [0, 0, 0], "radius": 0}):
        with pytest.raises(InputError, match=r"transforms\.json: key 'region'"):
            read_nerfstudio(write_transforms(edit=lambda meta, wrong=wrong: meta.update(region=wrong)))
