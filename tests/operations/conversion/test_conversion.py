"""A frame and a field that is a little wrong: what the frame knows is carried over, what it does not know is not invented."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic import MONO, MS, POL, RGB, AnalyticField, WrongField, ring_pose, scene_of, sphere

import mmsynth
from mmsynth.errors import InputError
from mmsynth.operations.conversion.files import convert_files
from mmsynth.operations.conversion.guidance import gain_exponent, guide, mapped_colour
from mmsynth.operations.conversion.methods import Converted, choose, convert_frame
from mmsynth.scene.scene import PosedCamera, Sensor
from mmsynth.sensors import filters
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.mosaic import mosaic, photosites_of
from mmsynth.sensors.polarization import angle_of_linear_polarization, degree_of_linear_polarization

CAMERA = Camera(96, 72, 100.0, 100.0, 47.3, 35.6, (-0.1, 0.05, 0.001, -0.002))
POSE = ring_pose(0, 4)


def truth(target: str, camera: Camera = CAMERA, pose: np.ndarray = POSE) -> Any:
    seen = AnalyticField(sphere()).render(camera, pose, [target])
    return seen.stokes[target] if target == "pol" else seen.channels[target]


def frame(source: Sensor, noise: float = 0.0, camera: Camera = CAMERA, pose: np.ndarray = POSE) -> np.ndarray:
    """What the sensor recorded."""
    image = np.nan_to_num(AnalyticField(sphere()).render(camera, pose, [source.name]).channels[source.name]).astype(np.float64)
    raw = image if source.mosaic is None else mosaic(torch.from_numpy(image).movedim(-1, 0), source.mosaic).numpy()
    return raw + noise * np.random.default_rng(0).normal(size=raw.shape) * np.sqrt(np.maximum(raw, 1e-3))


def converted(source: Sensor, target: str, method: str = "auto", field: Any = None, **how: Any) -> Converted:
    raw, names = how.pop("raw", frame(source)), {"source": source.name, "target": target}
    return convert_frame(field or WrongField(sphere()), raw, PosedCamera(CAMERA, POSE), method=method, **names, **how)  # type: ignore[arg-type]


def error(a: np.ndarray, b: np.ndarray) -> float:
    good = np.isfinite(a) & np.isfinite(b)
    good[:2] = good[-2:] = good[:, :2] = good[:, -2:] = False
    return float(np.sqrt(np.mean((a - b)[good] ** 2)))


@pytest.mark.parametrize("source", [RGB, MONO, MS, POL], ids=lambda s: s.name)
@pytest.mark.parametrize("target", ["rgb", "mono", "ms", "pol"])
def test_every_pair_gains_by_what_the_frame_knows(source: Sensor, target: str) -> None:
    """A pattern of 20 %, seen through noise of 1 % at full scale: five sixths of the error are mended."""
    field, raw = converted(source, target, "field"), frame(source, 0.01)
    auto = converted(source, target, "auto", raw=raw)
    values = lambda c: c.stokes if target == "pol" else c.values
    assert error(values(auto), truth(target)) < error(values(field), truth(target)) / 3
    assert auto.method in ("ratio", "guided") and auto.guided[auto.valid].mean() > 0.95
    assert 0.5 < auto.confidence[auto.valid].mean() < 1.0


def test_a_ratio_leaves_polarization_its_degree_and_angle() -> None:
    field, ratio = converted(RGB, "pol", "field"), converted(RGB, "pol", "ratio")
    lit = field.opacity > 0.5
    for of in (degree_of_linear_polarization, angle_of_linear_polarization):
        a, b = (of(torch.from_numpy(c.stokes[lit])).numpy() for c in (field, ratio))  # type: ignore[index]
        np.testing.assert_allclose(a, b, atol=1e-3)


def test_what_is_right_already_is_left_alone() -> None:
    """A field without error: noise of the frame must not become noise of the result."""
    exact: Any = AnalyticField(sphere())
    raw = frame(RGB, 0.01)
    found = converted(RGB, "ms", "auto", field=exact, raw=raw)
    noise = error(raw, frame(RGB)) / 0.3
    assert error(found.values, truth("ms")) < 0.2 * noise * 0.3
    assert found.confidence[found.valid].mean() > 0.9


@pytest.mark.parametrize("factor", [0.25, 0.5, 1.6])
def test_exposure_belongs_to_the_frame(factor: float) -> None:
    plain, other = converted(RGB, "ms"), converted(RGB, "ms", raw=factor * frame(RGB))
    assert other.exposure / plain.exposure == pytest.approx(factor, rel=0.02)
    assert error(plain.values, other.values) < 0.01


def test_what_is_not_in_the_field_is_masked_and_not_tinted() -> None:
    raw = frame(RGB)
    raw[20:34, 30:46] = mosaic(torch.tensor([0.9, 0.05, 0.05]).double()[:, None, None].expand(3, 72, 96), RGB.mosaic).numpy()[20:34, 30:46]  # type: ignore[arg-type]
    found, without = converted(RGB, "ms", raw=raw), converted(RGB, "ms", "field")
    inside = np.zeros((72, 96), bool)
    inside[23:31, 33:43] = True
    assert (found.confidence[inside] == 0).mean() > 0.9 and not found.guided[inside & (found.confidence == 0)].any()
    np.testing.assert_allclose(found.values[inside & ~found.guided], without.values[inside & ~found.guided], atol=1e-6)
    far = found.valid & ~np.roll(inside, 0)
    far[12:42, 22:54] = False
    assert (found.confidence[far] == 0).mean() < 0.02


def test_clipped_photosites_say_nothing() -> None:
    raw = frame(RGB)
    raw[30:40, 40:60] = 1.0
    found, without = converted(RGB, "mono", "ratio", raw=raw), converted(RGB, "mono", "field")
    np.testing.assert_allclose(found.values[33:37, 43:57], without.values[33:37, 43:57], rtol=0.02)


@pytest.mark.parametrize("raw", [np.zeros((72, 96)), np.ones((72, 96)), np.full((72, 96), 1e-9)])
def test_a_frame_that_says_nothing_leaves_the_field(raw: np.ndarray) -> None:
    found, without = converted(RGB, "ms", raw=raw), converted(RGB, "ms", "field")
    assert np.isfinite(found.values[found.valid]).all()
    assert found.exposure > 0
    if raw.min() == 1.0:
        np.testing.assert_allclose(found.values, without.values, atol=1e-6)


def test_as_the_target_sensor_would_have_seen_it() -> None:
    """From 5 cm beside: the same surface gets the frame's say, what the frame cannot see stays the field's."""

    class Painted(AnalyticField):
        """Wrong by a pattern on the surface, not in the picture."""

        wrong = True

        def render(self, camera: Camera, pose: np.ndarray, *args: Any, **how: Any) -> Any:
            seen = super().render(camera, pose, *args, **how)
            at = np.nan_to_num(pose[:3, 3] + np.nan_to_num(seen.depth_ray)[..., None] * (_rays(camera) @ pose[:3, :3].T))
            factor = np.where(np.isfinite(seen.depth_ray), 1 + 0.2 * np.sin(20 * at[..., 2]) * np.cos(17 * at[..., 0]), 1.0)
            if self.wrong:
                for values in (*seen.channels.values(), *seen.stokes.values()):
                    values /= factor[..., None].astype(np.float32)
            return seen

    beside = POSE.copy()
    beside[:3, 3] += 0.15 * POSE[:3, 0]
    field: Any = Painted(sphere())
    to_ms: Any = {"source": "mono", "target": "ms"}
    kept = convert_frame(field, frame(MONO), PosedCamera(CAMERA, POSE), method="field", seen_by=PosedCamera(CAMERA, beside), **to_ms)
    found = convert_frame(field, frame(MONO), PosedCamera(CAMERA, POSE), method="ratio", seen_by=PosedCamera(CAMERA, beside), **to_ms)
    lit = found.opacity > 0.5
    expected = truth("ms", CAMERA, beside)
    told = lit & found.guided
    rms = lambda c: np.sqrt(np.mean((c.values - expected)[told] ** 2))
    assert told.sum() > 0.8 * lit.sum() and rms(found) < rms(kept) / 1.8  # six tenths of it are taken
    np.testing.assert_array_equal(found.values[~found.guided], kept.values[~found.guided])
    # the ball hides its own far side: from behind nothing of the frame is seen
    behind = convert_frame(
        field, frame(MONO), PosedCamera(CAMERA, POSE), method="ratio", seen_by=PosedCamera(CAMERA, ring_pose(2, 4)), **to_ms
    )
    assert behind.guided[behind.opacity > 0.5].mean() < 0.05


def _rays(camera: Camera) -> np.ndarray:
    from mmsynth.sensors.camera import ray_map

    return ray_map(camera)[0]


def test_a_residual_colour_goes_through_the_linear_map_that_renderings_show() -> None:
    random = np.random.default_rng(0)
    x = random.random((40, 50, 3))
    matrix = random.normal(size=(5, 3))
    valid = np.ones((40, 50), bool)
    valid[:3] = False
    for colour in np.eye(3):  # each channel alone: a column of the map
        found = mapped_colour(x, x @ matrix.T + 0.3, valid, np.broadcast_to(colour, x.shape))
        np.testing.assert_allclose(found[12:], np.broadcast_to(matrix @ colour, (28, 50, 5)), atol=0.06)
    flat = lambda value: np.full((30, 30, 1), value)
    plain = mapped_colour(flat(0.5), flat(0.25), np.ones((30, 30), bool), flat(1.0))
    np.testing.assert_allclose(plain, 0.5, rtol=0.02)  # nothing varies: the whole picture's


@pytest.mark.parametrize("sensor", [RGB, MS, MONO], ids=lambda s: s.name)
def test_what_is_computed_by_bands_is_what_is_computed_at_once(sensor: Sensor, monkeypatch: pytest.MonkeyPatch) -> None:
    random, shape = np.random.default_rng(1), (61, 20)
    rendered = 0.3 + 0.1 * random.random((*shape, sensor.channel_count)).astype(np.float32)
    raw = (1.1 * rendered if sensor.mosaic is None else 1.1 * photosites_of(rendered, sensor.mosaic)) + 0.02 * random.random(
        shape if sensor.mosaic is not None else (*shape, 1)
    )
    valid = random.random(shape) > 0.05
    target = random.random((*shape, 4)).astype(np.float32)

    def all_of_it() -> list[np.ndarray]:
        found = guide(raw, rendered, sensor, valid)
        colour = mapped_colour(rendered, target, valid, found.residual_colour)
        return [found.gain, found.residual_colour, found.unexplained, gain_exponent(rendered, target, valid), colour]

    whole = all_of_it()
    monkeypatch.setattr(filters, "_BAND", 7 * 20)
    for banded, at_once in zip(all_of_it(), whole, strict=True):
        np.testing.assert_allclose(banded, at_once, atol=1e-6)


def test_the_gain_is_the_weighted_mean_that_it_should_be() -> None:
    """Flat light that is 10 % brighter than rendered: the exposure takes it all, and says so."""
    rendered = np.full((30, 40, 1), 0.5)
    found = guide(np.full((30, 40, 1), 0.55), rendered, MONO, np.ones((30, 40), bool))
    assert found.exposure == pytest.approx(1.1) and np.abs(found.gain - 1).max() < 1e-6
    half = np.full((30, 40, 1), 0.5)
    half[:, 25:] = 0.6
    found = guide(half, rendered, MONO, np.ones((30, 40), bool))
    assert found.exposure == pytest.approx(1.0) and found.gain[10, 35] == pytest.approx(1.2, abs=0.01)
    assert found.gain[10, 5] == pytest.approx(1.0, abs=0.01) and not found.unexplained.any()


def test_methods_by_name() -> None:
    """Without a scene auto goes by the kind of the modalities; what needs the scene says so."""
    field: Any = AnalyticField(sphere())
    kinds = {("rgb", "ms"): "guided", ("mono", "ms"): "ratio", ("rgb", "pol"): "ratio", ("pol", "rgb"): "ratio"}
    assert {pair: choose(field, None, *pair).method for pair in kinds} == kinds
    assert choose(field, None, "rgb", "ms", "field").method == "field"
    with pytest.raises(InputError, match="method is 'magic', expected one of auto, field, ratio, guided, linear, nearest"):
        choose(field, None, "rgb", "ms", "magic")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="method 'nearest' needs the scene's training frames"):
        choose(field, None, "rgb", "ms", "nearest")
    with pytest.raises(InputError, match=r"a frame of shape \(3, 4\), expected \(72, 96\) of rgb"):
        converted(RGB, "ms", raw=np.zeros((3, 4)))


def test_files_of_a_target_at_its_own_place(tmp_path: Path) -> None:
    field: Any = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", views=2, truth=False)
    convert_files(field, scene, tmp_path / "out", source="rgb", target="ms", frames=[1], as_sensor=True)
    sidecar = json.loads((tmp_path / "out/ms/0001.json").read_text())
    np.testing.assert_allclose(sidecar["camera"]["camera_to_world"], scene.frames_of("ms")[1].camera_to_world, atol=1e-12)
    assert sidecar["method"] == "auto" and sum(sidecar["weights"].values()) == pytest.approx(1.0)
    assert sidecar["evidence"]["views"] == [0] and "field" in sidecar["evidence"]["psnr"] and 0 <= sidecar["guided"] <= 1
    with np.load(tmp_path / "out/ms/0001.npz") as arrays:
        expected = mosaic(torch.from_numpy(arrays["data"]).movedim(-1, 0), MS.mosaic).numpy()  # type: ignore[arg-type]
        np.testing.assert_array_equal(arrays["raw"], expected)
        assert arrays["confidence"].shape == (18, 24) and arrays["guided"].dtype == bool


def test_tensors_in_batches() -> None:
    """As frames one by one, in kornia's layout."""
    field: Any = WrongField(sphere())
    poses = [POSE, ring_pose(1, 4)]
    raw = np.stack([frame(RGB), frame(RGB, pose=poses[1])])
    found = mmsynth.convert(
        field, torch.from_numpy(raw)[:, None], source="rgb", target="pol", poses=torch.from_numpy(np.stack(poses)), camera=CAMERA
    )
    assert found.values.shape == (2, 4, 72, 96) and found.stokes is not None and found.stokes.shape == (2, 3, 72, 96)
    assert found.confidence.shape == found.guided.shape == found.valid.shape == (2, 1, 72, 96) and found.method == "ratio"
    for i in range(2):
        one = convert_frame(field, raw[i], PosedCamera(CAMERA, poses[i]), source="rgb", target="pol")
        np.testing.assert_array_equal(found.stokes[i].numpy(), np.moveaxis(one.stokes, -1, 0))  # type: ignore[arg-type]
        assert float(found.exposure[i]) == pytest.approx(one.exposure, rel=1e-6)
    colours = torch.from_numpy(np.moveaxis(frame(MONO), -1, 0))[None]
    beside = torch.from_numpy(ring_pose(1, 90))[None]
    there = mmsynth.convert(
        field, colours, source="mono", target="ms", poses=torch.from_numpy(POSE)[None], camera=CAMERA, target_poses=beside, method="field"
    )
    assert there.values.shape == (1, 9, 18, 24)  # the camera of ms
    with pytest.raises(InputError, match=r"frames \(1, 72, 96\), poses \(2, 4, 4\); expected"):
        mmsynth.convert(field, torch.zeros(1, 72, 96), source="rgb", target="ms", poses=torch.zeros(2, 4, 4))
    with pytest.raises(InputError, match=r"a frame of shape \(72, 96, 2\), expected \(72, 96\) of rgb"):
        mmsynth.convert(field, torch.zeros(1, 2, 72, 96), source="rgb", target="ms", poses=torch.eye(4)[None], camera=CAMERA)
