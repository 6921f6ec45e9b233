"""Demosaicked and undistorted copies: against OpenCV, against pictures that are known along every ray, and read back as a scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from analytic import AnalyticField, scene_of, sphere
from conftest import HEIGHT, WIDTH, ring

from mmsynth.errors import InputError
from mmsynth.operations.export.demosaicked import is_plain, pinhole_of, write_demosaicked
from mmsynth.scene.image_writers import write_npz, write_png16
from mmsynth.scene.images import load_frame, read_native
from mmsynth.scene.load import load_scene
from mmsynth.scene.masks import read_mask
from mmsynth.scene.scene import Frame, Region, Scene, Sensor, Split
from mmsynth.sensors.camera import Camera, project, ray_map
from mmsynth.sensors.mosaic import photosites_of

BARREL = Camera(48, 36, 40.0, 41.0, 23.2, 17.9, (-0.12, 0.02, 0.001, -0.001))
PINCUSHION = replace(BARREL, distortion=(0.1, 0.0, 0.001, 0.0))
FISHEYE = replace(BARREL, distortion=(0.02, -0.003, 0.0, 0.0), lens="kannala_brandt")
QUAD = np.array([[2, 1], [3, 0]])


def light(directions: np.ndarray, channels: int) -> np.ndarray:
    """Smooth light along rays (H, W, 3) in the camera's axes: (H, W, C), other in every channel."""
    x, y = np.moveaxis(directions[..., :2] / directions[..., 2:], -1, 0)
    return np.stack([0.5 + 0.2 * np.cos((1 + 0.3 * c) * x) * np.sin(y + c) for c in range(channels)], -1)


def one_sensor(sensor: Sensor, camera: Camera, pictures: np.ndarray, root: Path, **options: Any) -> Scene:
    """A scene of three views of one picture; float files where the picture has alpha or more than three channels."""
    frames = []
    for view, pose in enumerate(ring(3)):
        path = root / f"{view}.png"
        if pictures.ndim == 3 and pictures.shape[2] > 3:
            path = path.with_suffix(".npz")
            write_npz(path, {"data": pictures.astype(np.float32)})
        else:
            write_png16(path, pictures)
        frames.append(Frame(sensor.name, view, path, camera, pose, **options))
    return Scene(root, "MMS-DATA", {sensor.name: sensor}, tuple(frames), Region((0.1, 0.2, 0.3), 0.8), Split((0, 1), (2,), "said"), "m")


def plain_sensor(name: str, channels: int, mosaic: np.ndarray | None = None, **options: Any) -> Sensor:
    return Sensor(name, tuple(f"c{c}" for c in range(channels)), (None,) * channels, mosaic, **options)


def test_a_copy_is_read_back_as_the_same_scene_without_mosaics_and_lenses(write_mmsdata: Callable[..., Path], tmp_path: Path) -> None:
    scene = load_scene(write_mmsdata(range(4), lambda meta: meta.update(test_ids=[1])))
    out = write_demosaicked(scene, tmp_path / "copy")
    assert out == tmp_path / "copy" and json.loads((out / "meta_data.json").read_text())["undistorted"] is True
    copy = load_scene(out)
    assert copy.problems == () and copy.split.test == scene.split.test == (1,) and copy.split.train == scene.split.train
    assert copy.unit == scene.unit and list(copy.sensors) == list(scene.sensors)
    assert copy.region.radius == pytest.approx(scene.region.radius) and copy.region.centre == pytest.approx(scene.region.centre)
    for ours, theirs in zip(copy.frames, scene.frames, strict=True):
        assert (ours.sensor, ours.view) == (theirs.sensor, theirs.view) and not any(ours.camera.distortion)
        np.testing.assert_allclose(ours.camera_to_world, theirs.camera_to_world, atol=1e-12)
        assert load_frame(copy.sensors[ours.sensor], ours)[0].shape == (HEIGHT, WIDTH, scene.sensors[ours.sensor].channel_count)
    for name, sensor in copy.sensors.items():
        assert sensor.mosaic is None and sensor.channels == scene.sensors[name].channels
        assert sensor.wavelengths_nm == scene.sensors[name].wavelengths_nm
    assert not is_plain(scene) and is_plain(copy)


def test_every_modality_of_a_rig_is_kept(tmp_path: Path) -> None:
    scene = scene_of(AnalyticField(sphere()), tmp_path / "scene")
    copy = load_scene(write_demosaicked(scene, tmp_path / "copy"))
    for name, sensor in copy.sensors.items():
        assert replace(sensor, saturation=0.998) == replace(scene.sensors[name], mosaic=None, saturation=0.998)
    assert not (tmp_path / "copy" / "gt").exists()


@pytest.mark.parametrize("camera", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])
def test_against_opencv(camera: Camera, tmp_path: Path) -> None:
    raw = np.random.default_rng(3).integers(0, 65536, (36, 48), dtype=np.uint16)
    bayer = plain_sensor("rgb", 3, np.array([[1, 2], [0, 1]]))
    scene = one_sensor(bayer, camera, raw / 65535.0, tmp_path / "scene")
    copy = load_scene(write_demosaicked(scene, tmp_path / "copy"))
    colour = cv2.demosaicing(raw, cv2.COLOR_BayerGR2RGB_EA)
    (plain,) = {frame.camera for frame in copy.frames}
    lens, K = np.array(camera.distortion), plain.matrix
    expected = cv2.undistort(colour, camera.matrix, lens, None, K)
    inside = cv2.undistort(np.ones((36, 48)), camera.matrix, lens, None, K) > 0.999  # cv2 blends with black at the rim
    assert inside.mean() > 0.9
    found = read_native(copy.frames[0].path).astype(float)
    # OpenCV rounds positions to 32nds of a pixel, from maps of two types: noise may differ by one step each way
    assert np.abs(found - expected)[inside].max() <= 65535 / 32 * 2


@pytest.mark.parametrize("camera", [BARREL, PINCUSHION, FISHEYE], ids=["barrel", "pincushion", "fisheye"])
@pytest.mark.parametrize("pattern", [None, QUAD], ids=["all channels", "mosaic"])
def test_light_is_where_its_rays_are(camera: Camera, pattern: np.ndarray | None, tmp_path: Path) -> None:
    sensor = plain_sensor("quad", 4, pattern, saturation=float("inf") if pattern is None else 0.998)  # as files of floats have it
    seen = light(ray_map(camera)[0], 4)
    scene = one_sensor(sensor, camera, seen if pattern is None else photosites_of(seen, pattern), tmp_path / "scene")
    copy = load_scene(write_demosaicked(scene, tmp_path / "copy"))
    frame = copy.frames[0]
    found, alpha = load_frame(copy.sensors["quad"], frame)
    error = np.abs(found - light(ray_map(frame.camera)[0], 4))
    assert alpha is None and error[2:-2, 2:-2].max() < (0.002 if pattern is None else 0.004)
    assert error.max() < 0.02  # a rim has neighbours on one side alone
    stored = read_native(frame.path)
    assert stored.dtype == (np.float32 if pattern is None else np.uint16)  # as the input's files


def test_the_pinhole_of_a_camera() -> None:
    assert pinhole_of(BARREL) == replace(BARREL, distortion=())
    for camera in (PINCUSHION, FISHEYE, BARREL):
        plain = pinhole_of(camera)
        assert plain.fx >= camera.fx and plain.fx / plain.fy == pytest.approx(camera.fx / camera.fy)
        assert not any(plain.distortion) and (plain.cx, plain.cy) == (camera.cx, camera.cy)
        seen = project(ray_map(plain)[0], camera)
        assert (seen >= -0.5).all() and (seen <= np.array([47.5, 35.5])).all()
    assert pinhole_of(PINCUSHION).fx > PINCUSHION.fx
    with pytest.raises(InputError, match="bends too much"):
        pinhole_of(replace(BARREL, fx=9.0, fy=9.0, distortion=(60.0, 0.0, 0.0, 0.0)))


def test_masks_and_alpha_go_along(tmp_path: Path) -> None:
    inside = np.zeros((36, 48))
    inside[12:26, 15:34] = 1
    write_png16(tmp_path / "mask.png", inside)
    sensor = plain_sensor("thermal", 1, saturation=float("inf"))
    picture = np.concatenate([light(ray_map(BARREL)[0], 1), inside[..., None]], -1).astype(np.float32)
    scene = one_sensor(sensor, BARREL, np.full((36, 48), 0.5), tmp_path / "scene", mask=tmp_path / "mask.png")
    for i, frame in enumerate(scene.frames):
        path = tmp_path / f"{i}.npz"
        write_npz(path, {"data": picture})
        scene = replace(scene, frames=tuple(replace(f, path=path) if f is frame else f for f in scene.frames))
    copy = load_scene(write_demosaicked(scene, tmp_path / "copy"), masks="object")
    frame = copy.frames[0]
    mask, (values, alpha) = read_mask(frame), load_frame(copy.sensors["thermal"], frame)
    expected = cv2.undistort(inside, BARREL.matrix, np.array(BARREL.distortion))
    assert mask is not None and alpha is not None and values.shape == (36, 48, 1)
    sure = (expected == 0) | (expected == 1)
    assert sure.mean() > 0.9 and np.array_equal(mask[sure], expected[sure] == 1)
    np.testing.assert_allclose(alpha, expected, atol=0.05)


def test_a_copy_that_is_there_is_kept_and_one_that_was_cut_off_is_made(write_mmsdata: Callable[..., Path], tmp_path: Path) -> None:
    scene = load_scene(write_mmsdata())
    out = write_demosaicked(scene, tmp_path / "copy")
    picture = next((out / "modalities" / "rgb").iterdir())
    original = picture.read_bytes()
    picture.write_bytes(b"edited")
    write_demosaicked(scene, out)
    assert picture.read_bytes() == b"edited"
    (out / "meta_data.json").unlink()
    write_demosaicked(scene, out)
    assert picture.read_bytes() == original
