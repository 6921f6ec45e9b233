"""The MMS-DATA reader, trap by trap."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import HEIGHT, WIDTH, frame_values, ring

from mmsynth.errors import InputError
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.images import load_frame
from mmsynth.scene.layouts.mmsdata import read_mmsdata
from mmsynth.scene.scene import Frame
from mmsynth.sensors.camera import project, unproject

Writer = Callable[..., Path]
POINTS = np.random.default_rng(3).uniform(-0.6, 0.6, (40, 3))


def pixels_of(frame: Frame, points: np.ndarray) -> np.ndarray:
    to_camera = np.linalg.inv(frame.camera_to_world)
    return project(points @ to_camera[:3, :3].T + to_camera[:3, 3], frame.camera)


def test_poses_and_distortion_agree_with_opencv(write_mmsdata: Writer) -> None:
    """World points go through worldtogt, the pose and the lens to the pixels that cv2 finds from the file's own numbers."""
    written: dict[str, Any] = {}
    scene = read_mmsdata(write_mmsdata(edit=written.update))
    entry = written["modalities"]["rgb"]
    to_metres = np.array(written["worldtogt"])
    matrix = np.array([[entry["fx"], 0, entry["cx"]], [0, entry["fy"], entry["cy"]], [0, 0, 1.0]])
    k1, k2, p1, p2, k3, k4 = entry["distortion_params"]
    for frame, item in zip(scene.frames_of("rgb"), entry["frames"], strict=True):
        camera_to_world = np.vstack([item["camtoworld"], [0, 0, 0, 1.0]]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        to_camera = np.linalg.inv(camera_to_world)
        rotation = cv2.Rodrigues(to_camera[:3, :3])[0]
        expected = cv2.projectPoints(POINTS, rotation, to_camera[:3, 3], matrix, np.array([k1, k2, p1, p2, k3, k4, 0.0, 0.0]))[0][:, 0]
        found = pixels_of(frame, POINTS @ to_metres[:3, :3].T + to_metres[:3, 3])
        np.testing.assert_allclose(found, expected, atol=1e-8)


def test_distortion_order_is_opencv(write_mmsdata: Writer) -> None:
    assert read_mmsdata(write_mmsdata()).frames[0].camera.distortion == (-0.12, 0.09, 0.01, -0.02, 0.003, 0.0)


def test_undistorted_scene_ignores_distortion(write_mmsdata: Writer) -> None:
    assert read_mmsdata(write_mmsdata(edit=lambda meta: meta.update(undistorted=True))).frames[0].camera.distortion == ()


def test_worldtogt_gives_metres_and_rigid_poses(write_mmsdata: Writer) -> None:
    scene = read_mmsdata(write_mmsdata())
    assert scene.unit == "m"
    np.testing.assert_allclose(scene.region.centre, (0.1, 0.2, 0.3))
    assert scene.region.radius == pytest.approx(0.25)
    for frame in scene.frames:
        rotation = frame.camera_to_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        centre = np.linalg.inv(frame.camera_to_world) @ [0.1, 0.2, 0.3, 1.0]
        np.testing.assert_allclose(centre[:3], [0, 0, 0.25 * np.sqrt(10.0)], atol=1e-12)  # straight ahead, not behind


def test_without_worldtogt_the_world_is_the_input_unit(write_mmsdata: Writer) -> None:
    scene = read_mmsdata(write_mmsdata(edit=lambda meta: meta.pop("worldtogt")))
    assert (scene.unit, scene.region.centre, scene.region.radius) == ("input unit", (0.0, 0.0, 0.0), 1.0)
    np.testing.assert_allclose(scene.frames[0].camera_to_world, ring(4)[0], atol=1e-12)


@pytest.mark.parametrize("matrix", [np.diag([1.0, 1, 2, 1]), np.diag([1.0, 1, -1, 1]), np.zeros((4, 4)), np.eye(3)])
def test_worldtogt_must_be_a_similarity(write_mmsdata: Writer, matrix: np.ndarray) -> None:
    root = write_mmsdata(edit=lambda meta: meta.update(worldtogt=matrix.tolist()))
    with pytest.raises(InputError, match=r"worldtogt.*similarity"):
        read_mmsdata(root)


def test_pixel_offset_moves_rays_not_pixels(write_mmsdata: Writer) -> None:
    def direction(offset: float, pixel: float) -> np.ndarray:
        scene = read_mmsdata(write_mmsdata(edit=lambda meta: meta.update(pixel_offset=offset)))
        return unproject(np.array([pixel, pixel]), scene.frames[0].camera)[0]

    np.testing.assert_allclose(direction(0.5, 3.0), direction(0.0, 3.5), atol=1e-12)


def test_ids_with_gaps_keep_their_frames(write_mmsdata: Writer) -> None:
    root = write_mmsdata(views=[0, 3, 9, 17, 49])
    scene = read_mmsdata(root)
    assert [frame.view for frame in scene.frames_of("nir")] == [0, 3, 9, 17, 49]
    assert (scene.split.train, scene.split.test) == ((0, 3, 17), (9, 49))
    pixels, _ = load_frame(scene.sensors["nir"], scene.frames_of("nir", (17,))[0])
    np.testing.assert_allclose(pixels[..., 0], frame_values(17), atol=1e-5)


def test_views_are_sorted_and_may_differ_between_modalities(write_mmsdata: Writer) -> None:
    def edit(meta: dict[str, Any]) -> None:
        meta["modalities"]["rgb"]["frames"].reverse()
        del meta["modalities"]["infrared"]["frames"][1:3]

    scene = read_mmsdata(write_mmsdata(edit=edit))
    assert [(frame.sensor, frame.view) for frame in scene.frames] == [
        ("rgb", 0),
        ("rgb", 1),
        ("rgb", 2),
        ("rgb", 3),
        ("nir", 0),
        ("nir", 3),
    ]
    assert scene.split.test == (3,) and scene.split.source == "the last view"


def test_ground_truth_folder_gives_the_test_views(write_mmsdata: Writer) -> None:
    root = write_mmsdata(views=range(10))
    for name in ("rgb/0002.npz", "infrared/0005.npz", "infrared/notes.txt", "rgb/0077.npz"):
        (root / "gt" / name).parent.mkdir(parents=True, exist_ok=True)
        (root / "gt" / name).write_bytes(b"")
    assert read_mmsdata(root).split.test == (2, 5)


def test_sensors_of_known_and_unknown_names(write_mmsdata: Writer) -> None:
    def edit(meta: dict[str, Any]) -> None:
        entry = meta["modalities"]["rgb"]
        meta["modalities"] = {
            "polarization": {**entry, "mosaick_pattern": [[2, 1], [3, 0]]},
            "multispectral": {**entry, "mosaick_pattern": [[4, 5, 6], [2, 1, 0], [3, 8, 7]]},
            "Thermal2": {**entry, "mosaick_pattern": [[0, 1]], "wavelengths_nm": [900, None]},
            "mono": {**entry, "mosaick_pattern": [[0]]},
        }

    root = write_mmsdata(edit=edit)
    for name in ("polarization", "multispectral", "Thermal2", "mono"):
        (root / "modalities" / name).symlink_to(root / "modalities" / "rgb")
    sensors = read_mmsdata(root).sensors
    assert list(sensors) == ["pol", "ms", "thermal2", "mono"]
    assert sensors["pol"].polarizer_angles_deg == (0, 45, 90, 135)
    assert sensors["ms"].channel_count == 9 and sensors["ms"].wavelengths_nm[0] == 692 and sensors["ms"].wavelengths_nm[8] is None
    thermal = sensors["thermal2"]
    assert thermal.mosaic is not None and thermal.mosaic.tolist() == [[0, 1]] and thermal.wavelengths_nm == (900.0, None)
    assert not thermal.is_polarization
    assert sensors["mono"].mosaic is None


def test_the_pattern_in_the_file_wins_and_raw_frames_stay_raw(write_mmsdata: Writer) -> None:
    scene = read_mmsdata(write_mmsdata(edit=lambda meta: meta["modalities"]["rgb"].update(mosaick_pattern=[[0, 1], [1, 2]])))
    mosaic = scene.sensors["rgb"].mosaic
    assert mosaic is not None and mosaic.tolist() == [[0, 1], [1, 2]]
    pixels, alpha = load_frame(scene.sensors["rgb"], scene.frames[0])
    assert alpha is None and pixels.shape == (HEIGHT, WIDTH)
    np.testing.assert_allclose(pixels, frame_values(0), atol=1e-5)


def test_demosaicked_scene_has_all_channels_at_every_pixel(write_mmsdata: Writer) -> None:
    root = write_mmsdata(edit=lambda meta: meta.update(raw=False))
    for view in range(4):
        write_png16(root / "modalities" / "rgb" / f"{view:04d}.png", frame_values(view, 3))
    scene = read_mmsdata(root)
    assert scene.sensors["rgb"].mosaic is None
    np.testing.assert_allclose(load_frame(scene.sensors["rgb"], scene.frames[2])[0], frame_values(2, 3), atol=1e-5)


def test_masks_are_found(write_mmsdata: Writer) -> None:
    root = write_mmsdata()
    write_png16(root / "masks" / "infrared" / "0002.png", np.ones((HEIGHT, WIDTH)))
    scene = read_mmsdata(root)
    assert [(frame.sensor, frame.view) for frame in scene.frames if frame.mask is not None] == [("nir", 2)]


def test_missing_images_are_left_out_with_one_sentence(write_mmsdata: Writer) -> None:
    root = write_mmsdata()
    for view in (1, 2):
        (root / "modalities" / "rgb" / f"{view:04d}.png").unlink()
    scene = read_mmsdata(root)
    assert [frame.view for frame in scene.frames_of("rgb")] == [0, 3]
    assert scene.problems == ("rgb: 2 of 4 frames have no image file and are left out.",)


def test_modality_without_images_is_refused_unless_left_out(write_mmsdata: Writer) -> None:
    root = write_mmsdata()
    for path in (root / "modalities" / "infrared").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="'infrared' has no image files"):
        read_mmsdata(root)
    assert list(read_mmsdata(root, ["rgb"]).sensors) == ["rgb"]


def test_bad_poses_are_named(write_mmsdata: Writer) -> None:
    def broken(change: Callable[[np.ndarray], None]) -> Path:
        def edit(meta: dict[str, Any]) -> None:
            frame = meta["modalities"]["infrared"]["frames"][2]
            pose = np.array(frame["camtoworld"])
            change(pose)
            frame["camtoworld"] = pose.tolist()

        return write_mmsdata(edit=edit)

    def set_nan(pose: np.ndarray) -> None:
        pose[1, 3] = np.nan

    def scale(pose: np.ndarray) -> None:
        pose[:, :3] *= 1.01

    def mirror(pose: np.ndarray) -> None:
        pose[:, 0] *= -1

    for change, word in ((set_nan, "not finite in row 1, column 3"), (scale, "not rigid"), (mirror, "reflection")):
        with pytest.raises(InputError, match=rf"meta_data\.json: modality 'infrared', frame 2: .*{word}"):
            read_mmsdata(broken(change))


def test_rounded_rotations_are_made_orthonormal(write_mmsdata: Writer) -> None:
    def edit(meta: dict[str, Any]) -> None:
        for frame in meta["modalities"]["rgb"]["frames"]:
            frame["camtoworld"] = np.round(frame["camtoworld"], 5).tolist()

    for frame, pose in zip(read_mmsdata(write_mmsdata(edit=edit), ["rgb"]).frames, ring(4), strict=True):
        rotation = frame.camera_to_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        np.testing.assert_allclose(rotation, turn @ pose[:3, :3], atol=2e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda meta: meta["modalities"]["rgb"].pop("fx"), "modality 'rgb': key 'fx' is missing"),
        (lambda meta: meta["modalities"]["rgb"].update(fx=-3.0), "modality 'rgb': camera: fx=-3.0"),
        (lambda meta: meta["modalities"]["rgb"].update(width=24.5), "key 'width' is 24.5, expected a whole number"),
        (lambda meta: meta["modalities"]["rgb"].pop("distortion_params"), "six numbers k1 k2 p1 p2 k3 k4"),
        (lambda meta: meta["modalities"]["rgb"].update(mosaick_pattern=[[0, 2]]), r"channels \[0, 2\]"),
        (lambda meta: meta["modalities"]["rgb"].update(mosaick_pattern=[[0, 1], [2]]), "matrix of channel numbers"),
        (lambda meta: meta["modalities"]["rgb"].update(wavelengths_nm=["red"]), "key 'wavelengths_nm'"),
        (lambda meta: meta["modalities"]["rgb"].update(channels=["a", "b"]), "key 'channels' has 2 entries, expected 3"),
        (lambda meta: meta["modalities"]["rgb"].update(camera_model="FOV"), "not supported yet"),
        (lambda meta: meta["modalities"]["rgb"].update(camera_model="OPENCV_FISHEYE"), "four numbers k1 k2 k3 k4"),
        (lambda meta: meta["modalities"]["rgb"].update(camera_model="FULL_OPENCV"), "eight numbers k1 k2 p1 p2 k3 k4 k5 k6"),
        (lambda meta: meta.update(test_ids=[True]), "key 'test_ids' is not a list of view ids"),
        (lambda meta: meta["modalities"]["rgb"]["frames"].append(meta["modalities"]["rgb"]["frames"][0]), "frame 0 is listed twice"),
        (lambda meta: meta["modalities"].update(nir=meta["modalities"]["infrared"]), "2 modalities are called 'nir'"),
        (lambda meta: meta.pop("modalities"), "key 'modalities' is missing"),
        (lambda meta: meta.pop("raw"), "key 'raw' is 'missing'"),
    ],
)
def test_wrong_keys_are_named(write_mmsdata: Writer, change: Callable[[dict[str, Any]], Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_mmsdata(write_mmsdata(edit=lambda meta: (change(meta), None)[1]))
