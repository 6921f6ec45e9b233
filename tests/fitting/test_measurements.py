"""Frames in memory: as they were stored, decoded as the readers of images say, and with the rays of their lenses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import ring

from mmsynth.errors import InputError
from mmsynth.field.kernels.drawing import in_camera
from mmsynth.fitting import directions, stored_frames
from mmsynth.fitting.directions import pixel_directions
from mmsynth.fitting.measurements import Measurements, draw, fingerprint, measure
from mmsynth.fitting.stored_frames import KINDS, in_threads, read_frames
from mmsynth.fitting.tiles import Tile, all_pixels, some_pixels, tile_size
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, Region, Sensor
from mmsynth.sensors.camera import Camera, ray_map

REGION = Region((0.0, 0.0, 0.0), 1.0)
CAMERA = Camera(24, 18, 25.0, 25.0, 11.5, 8.5)
MONO = Sensor("mono", ("mono",), (None,))
RGB = Sensor("rgb", ("R", "G", "B"), (None,) * 3)


def _frames(folder: Path, images: list[np.ndarray], sensor: Sensor = MONO, camera: Camera = CAMERA) -> tuple[Frame, ...]:
    listed = []
    for i, image in enumerate(images):
        path = folder / f"{sensor.name}_{i}.npy"
        np.save(path, image)
        listed.append(Frame(sensor.name, i, path, camera, ring(len(images))[i]))
    return tuple(listed)


def _images(random: np.random.Generator, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Of each kind, and floats that are codes."""
    codes = random.integers(0, 65536, shape, dtype=np.uint16)
    return [
        random.integers(0, 256, shape, dtype=np.uint8), codes, random.random(shape, np.float32) * 2,
        codes.astype(np.float32) / np.float32(65535), random.integers(0, 256, shape).astype(np.float32) / np.float32(255),
    ]  # fmt: skip


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (2, 1, 0, 4, 3), (1, 1, 0, 2, 1)])
@pytest.mark.parametrize("sensor", [MONO, RGB])
def test_frames_are_held_as_they_are_stored(order: tuple[int, ...], sensor: Sensor, tmp_path: Path) -> None:
    """Whatever the first frame of a sensor is: every frame keeps its own kind, and decodes to what the reader of images gives."""
    images = _images(np.random.default_rng(0), (18, 24) if sensor is MONO else (18, 24, 3))
    frames = _frames(tmp_path, [images[i] for i in order], sensor)
    stored = read_frames([(sensor, frame) for frame in frames])
    assert [KINDS[k].itemsize for k in stored.kind] == [(1, 2, 4, 2, 1)[i] for i in order]
    for i, frame in enumerate(frames):
        values = stored.data.view(KINDS[stored.kind[i]])[stored.start[i] :][: 18 * 24 * stored.stride[i]]
        scale = 1.0 if stored.kind[i] == 2 else np.iinfo(values.dtype).max
        assert np.array_equal(values.astype(np.float32) / np.float32(scale), load_frame(sensor, frame)[0].ravel())


def test_sixteen_bits_take_sixteen_bits(tmp_path: Path) -> None:
    frames = _frames(tmp_path, [np.zeros((18, 24), np.uint16)] * 5)
    assert len(read_frames([(MONO, frame) for frame in frames]).data) == 5 * 18 * 24 * 2


def test_what_is_drawn_is_what_images_hold(tmp_path: Path) -> None:
    """All values of all frames and no others, alpha and colours premultiplied, of a grey picture stored as colour, too."""
    random = np.random.default_rng(1)
    grey = random.integers(0, 256, (18, 24, 1), np.uint8)
    images = {
        MONO: [*_images(random, (18, 24)), np.repeat(grey, 3, 2), np.concatenate([np.repeat(grey, 3, 2), 255 - grey], 2)],
        RGB: [random.integers(0, 256, (18, 24, 4), np.uint8), random.integers(0, 65536, (18, 24, 3), np.uint16)],
    }
    frames = {s.name: (s, _frames(tmp_path, images[s], s)) for s in images}
    measurements = measure(frames, REGION)
    batch = draw(measurements, None, {"mono": 60_000, "rgb": 20_000}, np.random.default_rng(0))
    for name, (rays, numbers) in batch.parts.items():
        sensor, listed = frames[name]
        first = int(measurements.modalities.first_frame[measurements.order.index(name)])
        target, alpha = batch.measured.target[numbers].reshape(rays.stop - rays.start, -1).numpy(), batch.alpha[rays].numpy()
        of_ray = batch.frame[numbers].reshape(len(target), -1)[:, 0] - first
        for i, frame in enumerate(listed):
            pixels, opacity = load_frame(sensor, frame)
            opacity = np.ones((18, 24), np.float32) if opacity is None else opacity
            held = np.concatenate([pixels * opacity[..., None], opacity[..., None]], 2).reshape(432, -1)
            found = np.concatenate([target, alpha[:, None]], 1)[of_ray == i]
            assert {*map(tuple, found)} == {*map(tuple, held)}


def test_a_changed_pixel_or_pose_is_noticed(tmp_path: Path) -> None:
    images = [np.random.default_rng(i).integers(0, 65536, (18, 24), dtype=np.uint16) for i in range(3)]
    frames = _frames(tmp_path, images)
    of = lambda listed: fingerprint(measure({"mono": (MONO, listed)}, REGION))
    before = of(frames)
    assert of(frames) == before
    moved = frames[0].camera_to_world.copy()
    moved[0, 3] += 1e-3
    assert of((replace(frames[0], camera_to_world=moved), *frames[1:])) != before
    images[2][17, 23] ^= 1
    np.save(frames[2].path, images[2])
    assert of(frames) != before


def test_the_first_frame_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    frames = _frames(tmp_path, [np.zeros((18, 24), np.uint8)] * 30)
    for i in (7, 20):
        frames[i].path.unlink()
    with pytest.raises(InputError, match=r"mono_7.npy: no such image file"):
        read_frames([(MONO, frame) for frame in frames])


def test_reading_tells_how_far_it_is(tmp_path: Path) -> None:
    said: list[tuple[int, int]] = []
    frames = _frames(tmp_path, [np.full((18, 24), 9, np.uint8)] * 4)
    measure({"mono": (MONO, frames)}, REGION, on_load=lambda done, total: said.append((done, total)))
    assert said == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert in_threads(lambda i: i * i, 5) == [0, 1, 4, 9, 16]


def test_frames_that_do_not_fit_into_memory_are_refused_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = _frames(tmp_path, [np.zeros((18, 24), np.uint16)] * 4)
    monkeypatch.setattr(stored_frames, "available_memory", lambda: 3000)
    with pytest.raises(InputError, match=r"4 training frames take 0.0 GB in memory, 0.0 GB are available; fit fewer frames") as refused:
        read_frames([(MONO, frame) for frame in frames])
    assert "\n" not in str(refused.value)


def test_damaged_pictures_are_named_by_any_thread(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """OpenCV has one level of its log for all threads: it is silent as long as one reads, and as before then."""
    level = cv2.utils.logging.getLogLevel()
    assert cv2.imwrite(str(tmp_path / "a.png"), np.zeros((18, 24), np.uint8))
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[45] ^= 255
    (tmp_path / "a.png").write_bytes(data)
    frames = [Frame("mono", i, tmp_path / "a.png", CAMERA, np.eye(4)) for i in range(6)]
    with pytest.raises(InputError, match="damaged PNG"):
        read_frames([(MONO, frame) for frame in frames])
    assert cv2.utils.logging.getLogLevel() == level and capfd.readouterr().err == ""


# --- directions


LENSES = {
    "pinhole": Camera(1200, 1000, 1100.0, 1090.0, 610.0, 480.0),
    "distorted": Camera(1200, 1000, 1100.0, 1090.0, 610.0, 480.0, (-0.25, 0.11, 1e-3, -5e-4, -0.02)),
    "fisheye": Camera(1200, 1000, 500.0, 505.0, 610.0, 480.0, (0.03, -0.01, 0.004, -0.001), "kannala_brandt"),
}


@pytest.mark.parametrize("lens", LENSES)
def test_directions_between_nodes_are_those_of_the_lens(lens: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In single precision; at every pixel, those at the frame's edges, too. Their memory is a hundredth of that of all directions."""
    monkeypatch.setattr(directions, "_MAPPED", 1000)
    camera = LENSES[lens]
    known, valid = pixel_directions([camera])
    assert valid == [None] and int(known.step[0]) >= 8 and len(known.nodes) < 1200 * 1000 / 50
    row, column = (torch.from_numpy(x.reshape(-1)) for x in np.mgrid[:1000, :1200])
    found = in_camera(known, torch.zeros_like(row), row, column).numpy()
    assert np.abs(found - ray_map(camera)[0].reshape(-1, 3)).max() < 4e-7


def test_small_cameras_have_the_directions_of_their_pixels() -> None:
    known, valid = pixel_directions(list(LENSES.values())[:2])
    assert known.step.tolist() == [1, 1] and valid == [None, None] and known.first.tolist() == [0, 1_200_000]
    exact = np.concatenate([ray_map(c)[0].reshape(-1, 3).astype(np.float32) for c in list(LENSES.values())[:2]])
    assert np.array_equal(known.nodes.numpy(), exact)


def test_a_lens_that_folds_within_the_frame_is_never_interpolated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(directions, "_MAPPED", 1000)
    camera = Camera(600, 500, 300.0, 300.0, 300.0, 250.0, (-0.3, 0.0, 0.0, 0.0))
    known, valid = pixel_directions([camera])
    assert known.step.tolist() == [1] and valid[0] is not None
    assert np.array_equal(valid[0], ray_map(camera)[1]) and 0 < (~valid[0]).sum() < 300_000


def test_pixels_without_a_ray_are_never_drawn(tmp_path: Path) -> None:
    camera = Camera(60, 50, 30.0, 30.0, 30.0, 25.0, (-0.3, 0.0, 0.0, 0.0))
    usable = ray_map(camera)[1]
    image = np.where(usable, 100, 200).astype(np.uint8)
    measurements = measure({"mono": (MONO, _frames(tmp_path, [image] * 3, MONO, camera))}, REGION)
    assert 0 < measurements["mono"].pixels == 3 * usable.sum() < measurements["mono"].total
    batch = draw(measurements, None, {"mono": 5000}, np.random.default_rng(0))
    assert (batch.measured.target == np.float32(100) / np.float32(255)).all()


# --- tiles


@pytest.mark.parametrize(
    ("pixels", "rays", "tile"),
    [(864_000, 1e9, (8, 4)), (864_000, 1.1e5, (8, 8)), (250_000_000, 1e9, (32, 32)), (250_000_000, 6e5, (64, 64)), (400, 0.0, (32, 16))],
)
def test_tiles_are_as_small_as_can_be_counted_and_looked_at_often(pixels: int, rays: float, tile: tuple[int, int]) -> None:
    assert tile_size(pixels, rays) == tile


def test_tiles_cut_frames_row_by_row() -> None:
    tile, chosen = Tile(8, 4), np.zeros((6, 10), bool)
    assert all_pixels([(6, 10)], tile).pixels.tolist() == [32, 8, 16, 4]
    chosen[0, 1] = chosen[1, 0] = chosen[0, 8] = chosen[5, 9] = True
    found = some_pixels(chosen, tile)
    assert found.pixels.tolist() == [2, 1, 0, 1] and found.words.tolist() == [1 << 1 | 1 << 8, 1, 0, 1 << 9]
    assert np.array_equal(some_pixels(np.ones((6, 10), bool), tile).pixels, all_pixels([(6, 10)], tile).pixels)


def test_poses_are_moved_of_one_modality_alone(tmp_path: Path) -> None:
    image = np.full((18, 24), 9, np.uint8)
    listed = {s.name: (s, _frames(tmp_path, [image if s is MONO else np.repeat(image[..., None], 3, 2)] * 2, s)) for s in (MONO, RGB)}
    measurements: Measurements = measure(listed, REGION)
    poses = np.stack([f.camera_to_world for f in listed["rgb"][1]])
    poses[:, :3, 3] *= 2.0
    measurements.set_poses("rgb", poses)
    far = measurements.frames.origin.norm(dim=1)
    first = int(measurements.modalities.first_frame[measurements.order.index("rgb")])
    assert far[first : first + 2].min() > 1.9 * far[:first].max() or far[first : first + 2].min() > 1.9 * far[first + 2 :].max()
    np.testing.assert_allclose(measurements["rgb"].origins, poses[:, :3, 3], rtol=1e-6)
