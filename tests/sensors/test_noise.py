"""Noise in closed form: means, variances, correlations, and the photon transfer curve that gives the figures back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from mmsynth.errors import InputError
from mmsynth.sensors.noise import NoiseModel, generator, record
from mmsynth.sensors.photon_transfer import photon_transfer

CAMERA = NoiseModel(bits=12, gain_dn_e=0.4, full_well_e=10500.0, read_e=5.0, black_dn=64.0)


def _flat(level: float, model: NoiseModel = CAMERA, size: tuple[int, int] = (200, 250), frames: int = 1, **how: Any) -> np.ndarray:
    light = torch.full((frames, *size), level, dtype=torch.float64)
    return record(light, model, range(frames), "cam", **how).numpy()


@pytest.mark.parametrize("level", [0.02, 0.2, 0.7])
def test_mean_and_variance_follow_the_photon_transfer_equation(level: float) -> None:
    raw = _flat(level)
    mean = CAMERA.black_dn + level * (CAMERA.white_dn - CAMERA.black_dn)
    variance = 0.4**2 * 25 + 1 / 12 + 0.4 * (mean - 64)
    n = raw.size
    assert abs(raw.mean() - mean) < 4 * math.sqrt(variance / n)
    assert raw.var() == pytest.approx(variance, rel=4 * math.sqrt(2 / n))
    assert (raw == np.rint(raw)).all()


def test_dark_current_and_dark_pattern() -> None:
    model = NoiseModel(12, 0.5, 8000.0, black_dn=100.0, dark_e_s=40.0, exposure_s=2.0, dsnu_e=6.0)
    raw = _flat(0.0, model, frames=40)
    assert raw.mean() == pytest.approx(100 + 0.5 * 80, abs=0.1)
    assert raw.var(0, ddof=1).mean() == pytest.approx(0.25 * 80 + 1 / 12, rel=0.02)  # shot noise of the dark current
    assert raw.mean(0).std() == pytest.approx(math.sqrt(9.0 + (20.0 + 1 / 12) / 40), rel=0.02)  # the pattern stays from frame to frame


def test_response_pattern() -> None:
    model = NoiseModel(16, 4.0, 60000.0, prnu=0.02)
    raw = _flat(0.5, model, frames=40)
    electrons = 0.5 * model.electrons_at_one
    expected = math.sqrt((0.02 * electrons) ** 2 + electrons / 40)
    assert raw.mean(0).std() / 4.0 == pytest.approx(expected, rel=0.02)
    # the same pattern in bright and dark, in proportion
    bright, dark = (x.mean(0) - x.mean() for x in (raw, _flat(0.25, model, frames=40)))
    assert float((bright * dark).sum() / (dark * dark).sum()) == pytest.approx(2.0, rel=0.1)


def test_rows_have_noise_in_common() -> None:
    raw = _flat(0.1, NoiseModel(14, 1.0, 20000.0, row_e=12.0), frames=4)
    between = raw.mean(2).var()
    within = raw.var()
    electrons = 0.1 * (2**14 - 1)
    assert between == pytest.approx(144 + electrons / 250, rel=0.15)
    assert within == pytest.approx(144 + electrons, rel=0.1)
    columns = raw - raw.mean(2, keepdims=True)
    assert abs(np.mean(columns[:, 1:] * columns[:, :-1])) < 0.02 * columns.var()  # nothing else is common


def test_saturation_and_black_clip() -> None:
    assert (_flat(3.0) == 4095).all()
    small = NoiseModel(12, 0.4, 5000.0, read_e=5.0)
    assert (_flat(0.9, small) == 2000).all()  # the pixel is full before the converter is
    dark = _flat(0.0, NoiseModel(12, 0.4, 5000.0, read_e=5.0))
    assert dark.min() == 0 and 0.5 < (dark == 0).mean() < 0.8  # half and what rounds to 0


def test_a_frame_depends_on_its_key_alone() -> None:
    model = NoiseModel(12, 0.4, 9000.0, 5.0, 64.0, 10.0, 1.0, 2.0, 3.0, 0.01)
    light = torch.rand(5, 20, 30, dtype=torch.float64)
    whole = record(light, model, range(5), "cam", seed=7)
    backwards = record(light.flip(0), model, [4, 3, 2, 1, 0], "cam", seed=7).flip(0)
    alone = record(light[3:4], model, [3], "cam", seed=7)
    assert torch.equal(whole, backwards) and torch.equal(whole[3:4], alone)
    for other in (record(light, model, range(5), "cam", seed=8), record(light, model, range(5), "rgb", seed=7)):
        assert (other != whole).double().mean() > 0.5
    states = {
        int(torch.randint(2**62, (), generator=generator(*k)))
        for k in [(0, "a", "x"), (0, "a", "x", 0), (0, "a", "y"), (0, "b", "x"), (1, "a", "x")]
    }
    assert len(states) == 5


def test_gradients_pass_noise_and_end_at_saturation() -> None:
    light = torch.tensor([[[0.3, 0.6, 1.4]]], dtype=torch.float64, requires_grad=True)
    record(light, NoiseModel(12, 0.4, 20000.0, 5.0, 64.0), [0], "cam").sum().backward()
    assert light.grad.tolist() == [[[4031.0, 4031.0, 0.0]]]  # type: ignore[union-attr]


@pytest.mark.parametrize("prnu", [0.0, 0.01])
@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_the_curve_gives_the_figures_back(prnu: float, wrong: float) -> None:
    """Also when some pixels are far from what they were expected to be, as at edges of a field."""
    model = NoiseModel(12, 0.4, 10500.0, 5.0, 64.0, prnu=prnu)
    random = np.random.default_rng(0)
    light = torch.from_numpy(random.random((4, 200, 250)) ** 2)
    raw = record(light, model, range(4), "cam").numpy().ravel()
    expected = (64 + light.numpy() * (4095 - 64)).ravel()
    outliers = random.random(len(raw)) < wrong
    raw[outliers] = np.clip(raw[outliers] + random.normal(0, 400, outliers.sum()), 0, 4095)
    found = photon_transfer(raw, expected, 12, 64.0)
    loose = 1.0 if wrong == 0 else 2.5
    assert found.gain_dn_e == pytest.approx(0.4, rel=0.02 * loose)
    assert found.read_e == pytest.approx(5.0, rel=0.1 * loose)
    assert found.prnu == pytest.approx(prnu, abs=0.0035)
    if wrong == 0:
        assert abs(found.gain_dn_e - 0.4) < 4 * found.gain_sd and 0 < found.gain_sd < 0.01
        assert abs(found.read_e - 5.0) < 4 * found.read_sd and 0 < found.read_sd < 0.5


def test_figures_that_cannot_be_are_refused() -> None:
    for wrong in ({"bits": 17}, {"gain_dn_e": 0.0}, {"read_e": -1.0}, {"black_dn": 5000.0}, {"prnu": math.nan}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            NoiseModel(**{"bits": 12, "gain_dn_e": 0.4, "full_well_e": 1e4, **wrong})  # type: ignore[arg-type]


def test_values_that_tell_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="usable values"):
        photon_transfer(np.full(20, 100.0), np.full(20, 100.0), 12)
    with pytest.raises(InputError, match="no range of light"):
        photon_transfer(_flat(0.3).ravel(), np.full(50000, 64 + 0.3 * 4031), 12, 64.0)
    random = np.random.default_rng(0)
    flat = random.uniform(200, 3000, 50000)
    with pytest.raises(InputError, match="does not grow with light"):
        photon_transfer(flat + 5 * np.sqrt(3200 - flat) * random.normal(size=50000) / 10, flat, 12)
