"""Where rays go: as often as residuals ask for, and without a bias of what is learned."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from mmsynth.fitting.importance import RUN, Importance


def _learned(size: int, evenly: float, seed: int, spread: float = 1.0) -> Importance:
    """A modality of which every run was looked at many times, with residuals over ``spread`` powers of ten."""
    residual = 10.0 ** np.random.default_rng(seed).uniform(-spread, 0.0, -(-size // RUN))
    importance = Importance({"a": size}, evenly)
    for _ in range(60):
        importance.learn("a", RUN * np.arange(len(residual)), residual)
    importance.renew()
    return importance


@settings(max_examples=40, deadline=None)
@given(size=st.integers(1, 2000), evenly=st.floats(0.05, 1.0), seed=st.integers(0, 1000))
def test_weighted_rays_stand_for_every_pixel_alike(size: int, evenly: float, seed: int) -> None:
    """Probability times weight, of each pixel, is one over their number; no ray weighs more than 1 / evenly."""
    importance = _learned(size, evenly, seed)
    pixel, weight = importance.draw("a", 500, np.random.default_rng(seed))
    assert pixel.min() >= 0 and pixel.max() < size and weight.dtype == np.float32
    assert weight.max() <= 1.001 / evenly
    residual = importance.residuals["a"].astype(np.float64)
    length = np.minimum(RUN, size - RUN * np.arange(len(residual)))
    of_pixel = evenly / size + (1.0 - evenly) * residual / (residual * length).sum()
    np.testing.assert_allclose(of_pixel[pixel // RUN] * weight, 1.0 / size, rtol=1e-5)


def test_runs_are_drawn_as_often_as_their_residuals_ask_for() -> None:
    size, count = 10 * RUN + 5, 100_000
    importance = _learned(size, 0.5, 0)
    residual, length = importance.residuals["a"], np.array([RUN] * 10 + [5])
    expected = count * length * (0.5 / size + 0.5 * residual / (residual * length).sum())
    pixel, _ = importance.draw("a", count, np.random.default_rng(1))
    assert stats.chisquare(np.bincount(pixel // RUN, minlength=11), expected * (count / expected.sum())).pvalue > 1e-3
    within = np.bincount(pixel[pixel < RUN], minlength=RUN)  # evenly, of one run
    assert stats.chisquare(within).pvalue > 1e-3


def test_many_pixels_have_longer_runs() -> None:
    """A rig of 25 Mpixel times 100 frames: what is counted stays small, and every pixel can be drawn."""
    size = 2_500_000_000
    importance = Importance({"a": size}, 0.5)
    assert len(importance.residuals["a"]) <= 2**18
    pixel, weight = importance.draw("a", 50_000, np.random.default_rng(0))
    assert stats.kstest(pixel / size, "uniform").pvalue > 1e-3 and np.allclose(weight, 1.0)
    importance.learn("a", pixel, np.zeros(len(pixel)))
    importance.renew()
    assert importance.draw("a", 50_000, np.random.default_rng(0))[1].max() <= 2.001


def test_all_evenly_is_as_without() -> None:
    importance = _learned(1000, 1.0, 3)
    pixel, weight = importance.draw("a", 20_000, np.random.default_rng(0))
    np.testing.assert_allclose(weight, 1.0, rtol=1e-6)
    assert stats.kstest(pixel / 1000, "uniform").pvalue > 1e-3


def test_where_nothing_was_looked_at_yet_rays_go_first() -> None:
    importance = Importance({"a": 100 * RUN}, 0.5)
    for _ in range(60):
        importance.learn("a", RUN * np.arange(50), np.full(50, 0.1))
    importance.renew()
    pixel, _ = importance.draw("a", 10_000, np.random.default_rng(0))
    assert (pixel >= 50 * RUN).mean() == pytest.approx(0.5 * 0.5 + 0.5 * 1.0 / 1.1, abs=0.02)


def test_a_model_without_a_residual_is_drawn_from_as_before() -> None:
    importance = Importance({"a": 64}, 0.5)
    for _ in range(1000):
        importance.learn("a", np.array([0, RUN]), np.zeros(2))
    importance.renew()
    assert importance.residuals["a"].max() < 1e-40 and np.isfinite(importance.density["a"]).all()
    assert np.isfinite(importance.draw("a", 10, np.random.default_rng(0))[1]).all()


def test_a_state_that_was_saved_draws_the_same() -> None:
    importance = _learned(777, 0.5, 5)
    importance.learn("a", np.array([3, 400]), np.array([2.0, 3.0]))  # after the last renewal: not yet in what is drawn from
    again = Importance({"a": 777}, 0.5)
    again.load_state_dict(importance.state_dict())
    for renewed in (False, True):
        if renewed:
            importance.renew()
            again.renew()
        ours, theirs = (x.draw("a", 100, np.random.default_rng(2)) for x in (importance, again))
        assert np.array_equal(ours[0], theirs[0]) and np.array_equal(ours[1], theirs[1])


def test_a_highlight_is_estimated_with_less_noise() -> None:
    """One pixel in fifty has a residual twenty times as large: the noise of the mean gradient of a step of 400 rays."""
    size, random = 200 * RUN, np.random.default_rng(0)
    residual = np.full(200, 0.05)
    residual[::50] = 1.0
    gradient = np.repeat(residual, RUN) * random.choice([-1.0, 1.0], size)
    importance = Importance({"a": size}, 0.5)
    for _ in range(60):
        importance.learn("a", RUN * np.arange(200), residual)
    importance.renew()
    even = [gradient[random.integers(0, size, 400)].mean() for _ in range(2000)]
    drawn = [importance.draw("a", 400, random) for _ in range(2000)]
    weighted = [(gradient[pixel] * weight).mean() for pixel, weight in drawn]
    assert np.std(weighted) < 0.6 * np.std(even)
    assert abs(np.mean(weighted) - gradient.mean()) < 4 * np.std(weighted) / 2000**0.5
