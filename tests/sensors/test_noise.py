"""Noise in closed form: means, variances, correlations."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from mmsynth.errors import InputError
from mmsynth.sensors.noise import NoiseModel, generator, record

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


# --- crosstalk


def _correlation(flat: np.ndarray, row: int, column: int) -> float:
    """Of what is left of a flat field (frames, H, W) with what is left so many rows and columns on."""
    height, width = flat.shape[1:]
    one, other = flat[:, : height - row, : width - column], flat[:, row:, column:]
    return float((one * other).mean() / flat.var())


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2])
def test_crosstalk_correlates_the_shot_noise_of_neighbours(share: float) -> None:
    """The kernel (1 - 4c, four times c) on white noise: its autocorrelation. 0.2 is the most: all five the same."""
    raw = _flat(0.3, NoiseModel(16, 1.0, 1e6, crosstalk=share), frames=4)
    electrons, own = 0.3 * (2**16 - 1), 1.0 - 4.0 * share
    power = own**2 + 4 * share**2
    expected = {
        (0, 1): 2 * share * own,
        (1, 0): 2 * share * own,
        (1, 1): 2 * share**2,
        (0, 2): share**2,
        (2, 0): share**2,
        (0, 3): 0,
        (2, 1): 0,
    }
    # crosstalk moves electrons and loses none: the mean is known as well as without it
    assert abs(raw.mean() - electrons) < 4 * math.sqrt((electrons + 1 / 12) / raw.size)
    left = (raw - electrons)[:, 1:-1, 1:-1]
    # of n values with the correlations ρ, a variance is known to √(2 Σ ρ² / n), and a correlation at least as well
    rho2 = 1 + (4 * (2 * share * own) ** 2 + 4 * (2 * share**2) ** 2 + 4 * share**4) / power**2
    sd = math.sqrt(2 * rho2 / left.size)
    assert left.var() == pytest.approx(electrons * power + 1 / 12, rel=4 * sd)
    for (row, column), covariance in expected.items():
        assert abs(_correlation(left, row, column) - covariance / power) < 4 * sd


def test_crosstalk_keeps_what_would_leave_the_frame() -> None:
    """Mean as elsewhere; a pixel at a border keeps 1 - 3c, in a corner 1 - 2c."""
    share, frames = 0.1, 300
    raw = _flat(0.3, NoiseModel(16, 1.0, 1e6, crosstalk=share), (12, 15), frames)
    electrons = 0.3 * (2**16 - 1)
    edge = np.concatenate([raw[:, 0, 3:-3:3], raw[:, -1, 3:-3:3], raw[:, 3:-3:3, 0], raw[:, 3:-3:3, -1]], 1)
    corners = raw[:, [0, 0, -1, -1], [0, -1, 0, -1]]
    for part, kept in ((edge, 3), (corners, 2)):
        power = (1 - kept * share) ** 2 + kept * share**2
        assert abs(part.mean() - electrons) < 4 * math.sqrt(electrons * power / part.size)
        assert part.var() == pytest.approx(electrons * power, rel=4 * math.sqrt(2 / part.size))


def test_crosstalk_shares_the_light_of_a_point_and_nothing_else() -> None:
    model = NoiseModel(16, 1e-3, 1e9, black_dn=100.0, crosstalk=0.1)
    light = torch.zeros(1, 9, 9, dtype=torch.float64)
    light[0, 4, 4] = light[0, 0, 0] = 0.5
    raw = record(light, model, [0], "cam")[0].numpy() - 100.0
    assert raw.sum() == pytest.approx(65435, abs=4 * math.sqrt(65435 * 1e-3) + 3)  # K² of the electrons, and rounding
    full = 0.5 * 65435
    around = {(4, 4): 0.6, (3, 4): 0.1, (5, 4): 0.1, (4, 3): 0.1, (4, 5): 0.1, (0, 0): 0.8, (0, 1): 0.1, (1, 0): 0.1}
    for at, share in around.items():
        assert raw[at] == pytest.approx(share * full, abs=4 * share * math.sqrt(full * 1e-3) + 0.5)
        raw[at] = 0.0
    assert not raw.any()
    # read noise comes after it and belongs to one pixel
    dark = _flat(0.0, NoiseModel(16, 1.0, 1e6, read_e=20.0, black_dn=1000.0, crosstalk=0.2))
    assert dark.var() == pytest.approx(400 + 1 / 12, rel=4 * math.sqrt(2 / dark.size))
    assert abs(_correlation(dark - dark.mean(), 0, 1)) < 4 / math.sqrt(dark.size)


def test_crosstalk_up_to_a_fifth_is_accepted() -> None:
    assert NoiseModel(12, 0.4, 1e4, crosstalk=0.2).crosstalk == 0.2
    with pytest.raises(InputError, match=r"crosstalk is 0\.21, expected at most 0\.2"):
        NoiseModel(12, 0.4, 1e4, crosstalk=0.21)


# --- keys, gradients, refusals


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


def test_figures_that_cannot_be_are_refused() -> None:
    for wrong in ({"bits": 17}, {"gain_dn_e": 0.0}, {"read_e": -1.0}, {"black_dn": 5000.0}, {"prnu": math.nan}, {"crosstalk": 0.21}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            NoiseModel(**{"bits": 12, "gain_dn_e": 0.4, "full_well_e": 1e4, **wrong})  # type: ignore[arg-type]
