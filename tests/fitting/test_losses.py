"""What is drawn, predicted and compared, on a joined batch of all modalities, against formulas written out per modality."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from conftest import ring
from hypothesis import given, settings
from hypothesis import strategies as st

from mmsynth.field.kernels import Measured, photometric, predict, residual
from mmsynth.fitting.measurements import Batch, Measurements, draw, measure
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, Region, Sensor
from mmsynth.sensors.camera import Camera, project
from mmsynth.sensors.mosaic import channel_map

REGION = Region((0.3, -0.2, 0.1), 1.5)
CAMERAS = Camera(24, 18, 25.0, 26.0, 11.7, 8.4, (-0.12, 0.09, 0.01, -0.02)), Camera(24, 18, 31.0, 31.0, 11.5, 8.5)
# radiance and polarization, each with a mosaic and without
SENSORS = [
    Sensor("pol", ("0", "45", "90", "135"), (None,) * 4, np.array([[2, 1], [3, 0]]), (0.0, 45.0, 90.0, 135.0), 0.9),
    Sensor("rgb", ("R", "G", "B"), (None,) * 3, np.array([[1, 2], [0, 1]]), None, 0.8),
    Sensor("film", ("R", "G", "B"), (None,) * 3),
    Sensor("mono", ("mono",), (None,), None, None, 0.7),
    Sensor("pol3", ("0", "60", "120"), (None,) * 3, None, (0.0, 60.0, 120.0), float("inf")),
]
BRIGHTNESS = {"pol": 0.5, "rgb": 1.0, "film": 0.02, "mono": 1.0, "pol3": 3.0}
FRAMES = 3


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Frame, ...]]:
    """Frames of random light, the second through another camera than the others."""
    root, random, out = tmp_path_factory.mktemp("frames"), np.random.default_rng(0), {}
    for sensor in SENSORS:
        shape = (18, 24) if sensor.mosaic is not None or sensor.channel_count == 1 else (18, 24, sensor.channel_count)
        for view, pose in enumerate(ring(FRAMES)):
            path = root / f"{sensor.name}_{view}.npy"
            np.save(path, (random.random(shape) * BRIGHTNESS[sensor.name]).astype(np.float32))
            out.setdefault(sensor.name, []).append(Frame(sensor.name, view, path, CAMERAS[view % 2], pose))
    return {name: tuple(parts) for name, parts in out.items()}


@pytest.fixture(scope="module")
def measurements(frames: dict[str, tuple[Frame, ...]]) -> Measurements:
    return measure({s.name: (s, frames[s.name]) for s in SENSORS}, REGION)


RAYS = {"pol": 31, "rgb": 40, "film": 7, "mono": 1, "pol3": 12}
COLUMNS = {"pol": slice(0, 6), "rgb": slice(6, 9), "film": slice(9, 12), "mono": slice(12, 13), "pol3": slice(13, 19)}


@pytest.fixture(scope="module")
def batch(measurements: Measurements) -> Batch:
    return draw(measurements, COLUMNS, RAYS, np.random.default_rng(5))


def test_a_batch_joins_all_modalities(batch: Batch) -> None:
    per_ray = {"pol": 1, "rgb": 1, "film": 3, "mono": 1, "pol3": 3}
    assert set(batch.parts) == set(RAYS)
    at_ray = at_number = 0
    for name, (rays, numbers) in batch.parts.items():
        assert (rays.start, numbers.start) == (at_ray, at_number)
        assert rays.stop - rays.start == RAYS[name] and numbers.stop - numbers.start == RAYS[name] * per_ray[name]
        at_ray, at_number = rays.stop, numbers.stop
        assert batch.measured.ray[numbers].tolist() == np.repeat(np.arange(rays.start, rays.stop), per_ray[name]).tolist()
    assert len(batch.origins) == len(batch.directions) == len(batch.alpha) == at_ray
    for values in (
        batch.measured.target,
        batch.measured.ray,
        batch.measured.output,
        batch.measured.level,
        batch.measured.saturation,
        batch.measured.weight,
        batch.frame,
    ):
        assert len(values) == at_number
    # radiance before polarization
    assert [n.startswith("pol") for n in batch.parts] == [False] * 3 + [True] * 2
    assert len(batch.measured.axes) == RAYS["pol"] + 3 * RAYS["pol3"]
    assert batch.alpha.isnan().all()
    torch.testing.assert_close(batch.directions.norm(dim=1), torch.ones(at_ray))


def test_every_number_is_of_the_pixel_its_ray_goes_through(batch: Batch, frames: dict[str, tuple[Frame, ...]]) -> None:
    begin = 0
    for name, (rays, numbers) in batch.parts.items():
        sensor = next(s for s in SENSORS if s.name == name)
        seen = set()
        for m in range(numbers.start, numbers.stop):
            r = int(batch.measured.ray[m])
            frame = frames[name][int(batch.frame[m]) - begin]
            world = batch.origins[r].double().numpy() * REGION.radius + REGION.centre
            np.testing.assert_allclose(world, frame.camera_to_world[:3, 3], atol=1e-6)
            in_camera = frame.camera_to_world[:3, :3].T @ batch.directions[r].double().numpy()
            u, v = project(in_camera[None], frame.camera)[0]
            row, column = round(v), round(u)
            assert abs(u - column) < 1e-3 and abs(v - row) < 1e-3
            pixel = load_frame(sensor, frame)[0][row, column]
            of_ray = m - numbers.start - (r - rays.start) * sensor.channel_count  # which of the ray's numbers, without a mosaic
            if sensor.mosaic is not None:
                channel = int(channel_map(sensor.mosaic, 18, 24)[row, column])
                assert float(batch.measured.target[m]) == pixel
            else:
                channel = of_ray
                assert float(batch.measured.target[m]) == pixel[channel]
            seen.add(channel)
            if sensor.is_polarization:
                assert int(batch.measured.output[m]) == COLUMNS[name].start
                axis = batch.measured.axes[m - (len(batch.measured.ray) - len(batch.measured.axes))].double().numpy()
                # seen along the ray: the camera's x axis turned towards image up by the analyser's angle
                angle = np.deg2rad(sensor.polarizer_angles_deg[channel])
                x = frame.camera_to_world[:3, 0]
                d = batch.directions[r].double().numpy()
                x = (x - (x @ d) * d) / np.linalg.norm(x - (x @ d) * d)
                up = -np.cross(d, x)
                assert up @ frame.camera_to_world[:3, 1] < 0  # image down is y
                np.testing.assert_allclose(axis, np.cos(angle) * x + np.sin(angle) * up, atol=1e-6)
            else:
                assert int(batch.measured.output[m]) == COLUMNS[name].start + channel
        assert len(seen) == sensor.channel_count
        begin += FRAMES


def test_levels_saturations_and_weights_are_the_modalitys(batch: Batch, measurements: Measurements) -> None:
    for name, (_, numbers) in batch.parts.items():
        m = measurements[name]
        assert (batch.measured.level[numbers] == np.float32(m.radiance_scale)).all()
        assert m.radiance_scale == pytest.approx(BRIGHTNESS[name] / 2, rel=0.05)
        assert (batch.measured.saturation[numbers] == np.float32(m.sensor.saturation)).all()
    assert float(batch.measured.weight.sum()) == pytest.approx(1.0)


def test_a_batch_without_polarization_has_no_axes(measurements: Measurements) -> None:
    names = ("rgb", "mono")
    batch = draw(measurements, COLUMNS, dict.fromkeys(names, 5), np.random.default_rng(0))
    assert batch.measured.axes.shape == (0, 3)
    outputs = torch.randn(10, 19)
    torch.testing.assert_close(predict(outputs, torch.ones(10), batch.measured), _predicted_plainly(outputs, torch.ones(10), batch))
    only = draw(measurements, COLUMNS, {"pol": 5}, np.random.default_rng(0))
    torch.testing.assert_close(predict(outputs[:5], torch.ones(5), only.measured), _predicted_plainly(outputs[:5], torch.ones(5), only))


def test_the_same_random_state_draws_the_same_batch(measurements: Measurements) -> None:
    a, b, c = (draw(measurements, COLUMNS, RAYS, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert (
        torch.equal(a.measured.target, b.measured.target)
        and torch.equal(a.measured.axes, b.measured.axes)
        and not torch.equal(a.measured.target, c.measured.target)
    )


def _predicted_plainly(outputs: torch.Tensor, opacity: torch.Tensor, batch: Batch) -> torch.Tensor:
    """One number after the other."""
    found, bright = [], len(batch.measured.ray) - len(batch.measured.axes)
    for m, (ray, output) in enumerate(zip(batch.measured.ray.tolist(), batch.measured.output.tolist(), strict=True)):
        if m < bright:
            light = np.log1p(np.exp(float(outputs[ray, output])))
        else:
            a, b, c, d, e, f = outputs[ray, output : output + 6].double().tolist()
            a, b, c = (np.log1p(np.exp(x)) for x in (a, b, c))
            factor = np.array([[a, 0, 0], [d, b, 0], [e, f, c]])
            axis = batch.measured.axes[m - bright].double().numpy()
            light = axis @ factor @ factor.T @ axis
        found.append(light * float(batch.measured.level[m]) * float(opacity[ray]))
    return torch.tensor(found, dtype=torch.float32)


def test_predictions_are_the_formulas_of_each_modality(batch: Batch) -> None:
    torch.manual_seed(0)
    rays = len(batch.origins)
    outputs, opacity = torch.randn(rays, 19, requires_grad=True), torch.rand(rays, requires_grad=True)
    found = predict(outputs, opacity, batch.measured)
    torch.testing.assert_close(found, _predicted_plainly(outputs.detach(), opacity.detach(), batch), rtol=1e-5, atol=1e-7)
    # what a ray did not measure is not pulled at
    found.sum().backward()
    touched = torch.zeros(rays, 19, dtype=torch.bool)
    bright = len(batch.measured.ray) - len(batch.measured.axes)
    touched[batch.measured.ray[:bright], batch.measured.output[:bright]] = True
    for k in range(6):
        touched[batch.measured.ray[bright:], batch.measured.output[bright:] + k] = True
    assert not outputs.grad[~touched].any() and (outputs.grad[touched] != 0).float().mean() > 0.99
    assert (opacity.grad > 0).all()


def test_the_loss_is_a_mean_over_modalities_of_hubers_of_relative_residuals(batch: Batch) -> None:
    torch.manual_seed(1)
    predicted = batch.measured.target + torch.randn_like(batch.measured.target) * batch.measured.level
    total = 0.0
    for name, (_, numbers) in batch.parts.items():
        sensor = next(s for s in SENSORS if s.name == name)
        p, t = predicted[numbers].double().numpy(), batch.measured.target[numbers].double().numpy()
        difference = p - t
        difference[(t >= sensor.saturation) & (difference > 0)] = 0  # clipped: at least this much
        relative = np.abs(difference) / float(batch.measured.level[numbers][0])
        huber = np.where(relative < 0.5, 0.5 * relative**2, 0.5 * (relative - 0.25))
        total += huber.mean() / len(batch.parts)
    assert float(photometric(residual(predicted, batch.measured), batch.measured)) == pytest.approx(total, rel=1e-5)


def _alone(target: list[float], saturation: float, level: float) -> Batch:
    count = len(target)
    full = lambda value: torch.full((count,), value)
    number = torch.arange(count)
    output, no_axes = 0 * number, torch.empty(0, 3)
    measured = Measured(torch.tensor(target), number, output, no_axes, full(level), full(saturation), full(1 / count))
    parts = {"mono": (slice(0, count), slice(0, count))}
    zero, none = torch.zeros(count, 3), full(float("nan"))
    return Batch(zero, zero, full(0.5), measured, 0 * number, parts, none, full(1.0), 0 * number)


def test_saturated_targets_only_pull_upwards() -> None:
    difference = residual(torch.tensor([1.5, 0.5, 1.5]), _alone([1.0, 1.0, 0.9], 0.998, 1.0).measured)
    torch.testing.assert_close(difference, torch.tensor([0.0, -0.5, 0.6]))
    # a float image never clips
    assert residual(torch.tensor([9.0]), _alone([7.0], float("inf"), 1.0).measured).tolist() == [2.0]


@settings(deadline=None)
@given(st.floats(1e-4, 1e3))
def test_dark_modalities_weigh_as_much_as_bright_ones(level: float) -> None:
    relative = torch.linspace(-2, 2, 9)
    loss = photometric(relative * level, _alone([0.0] * 9, 1.0, level).measured)
    assert float(loss) == pytest.approx(float(photometric(relative, _alone([0.0] * 9, 1.0, 1.0).measured)), rel=1e-5)
