"""The Gaussian process of few frames, against the dense formula, and what it must never do."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from mmsynth.prior import correction
from mmsynth.prior.correction import LENGTHS, Correction, choose_lengths, choose_points, covariance, gain_of, learn, places_of

_MIDDLE = (0.3, 0.3)


def _places(count: int, seed: int = 0) -> torch.Tensor:
    random = torch.Generator().manual_seed(seed)
    return places_of(torch.rand(count, 3, generator=random) + 0.05, torch.rand(count, 3, generator=random) - 0.5, 0.5)


@pytest.mark.parametrize("lengths", LENGTHS)
def test_covariance_is_positive_definite_and_1_at_home(lengths: tuple[float, float]) -> None:
    places = _places(200).double()
    k = covariance(places, places, lengths)
    torch.testing.assert_close(k.diagonal(), torch.ones(200, dtype=torch.float64))
    assert torch.linalg.eigvalsh(k).min() > -1e-9
    torch.testing.assert_close(k, k.T)


def test_with_all_rows_as_points_it_is_the_dense_formula() -> None:
    places, random = _places(120), torch.Generator().manual_seed(1)
    part, rest = torch.rand(120, 1, generator=random) + 0.5, torch.randn(120, generator=random)
    size = torch.tensor([0.7])
    weights, unknown, _ = learn(places, (places, part, size, rest), _MIDDLE)
    made = Correction(1.0, places, weights, unknown, _MIDDLE, 1, 0.0, 0.0)
    new = _places(30, seed=9)
    f, deviation = made(new)
    # Rasmussen and Williams (2.25), (2.26), observations part x f + noise
    k = lambda a, b: size.double() ** 2 * covariance(a.double(), b.double(), _MIDDLE)
    p = part.double()
    noise = correction._ALIKE * float(rest.double().square().mean())
    gram = p * k(places, places) * p.T + noise * torch.eye(120, dtype=torch.float64)
    cross = k(new, places) * p.T
    expected = cross @ torch.linalg.solve(gram, rest.double())
    variance = size.double() ** 2 - (cross * torch.linalg.solve(gram, cross.T).T).sum(1)
    np.testing.assert_allclose(f[:, 0], expected, atol=2e-3)
    np.testing.assert_allclose(deviation[:, 0] * size, variance.sqrt(), atol=2e-3)


def test_the_noise_is_the_likeliest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(correction, "_ALIKE", 1.0)
    places, random = _places(60), torch.Generator().manual_seed(2)
    rows = (places, torch.rand(60, 1, generator=random) + 0.5, torch.tensor([0.7]), torch.randn(60, generator=random))
    features, _ = correction._features(places, rows, _MIDDLE)
    square = float(rows[3].double().square().mean())
    covariances = {share: (features @ features.T + share * square * torch.eye(60)).numpy() for share in correction._NOISE}
    by_share = {share: multivariate_normal(cov=cov).logpdf(rows[3].numpy()) for share, cov in covariances.items()}
    variance, likelihood = correction._likeliest_noise(features, rows[3])
    best = max(by_share, key=lambda share: by_share[share])
    assert variance == pytest.approx(best * square)
    assert likelihood == pytest.approx(by_share[best] + 30.0 * np.log(2.0 * np.pi), rel=1e-6)


@pytest.mark.parametrize("lengths", [LENGTHS[0], LENGTHS[-1]])
def test_lengths_are_found_again(lengths: tuple[float, float]) -> None:
    places, random = _places(4000), torch.Generator().manual_seed(3)
    own = covariance(places.double(), places.double(), lengths) + 1e-6 * torch.eye(4000)
    f = (torch.linalg.cholesky(own) @ torch.randn(4000, 1, generator=random, dtype=torch.float64))[:, 0].float()
    rest = f + 0.1 * torch.randn(4000, generator=random)
    found = choose_lengths(choose_points(places), [(places, torch.ones(4000, 1), torch.tensor([1.0]), rest)])
    assert found[0] == lengths[0]


def test_far_from_all_frames_nothing_changes() -> None:
    places = _places(100)
    weights, unknown, _ = learn(choose_points(places), (places, torch.ones(100, 1), torch.tensor([0.5]), torch.ones(100)), _MIDDLE)
    far = places[:5].clone()
    far[:, :3] += 30.0  # another colour
    f, deviation = Correction(1.0, choose_points(places), weights, unknown, _MIDDLE, 1, 0.0, 0.0)(far)
    assert f.abs().max() < 1e-4 and deviation.min() > 0.999


def test_where_frames_are_the_deviation_falls() -> None:
    places = _places(3000)
    weights, unknown, left = learn(choose_points(places), (places, torch.ones(3000, 1), torch.tensor([0.5]), 0.3 * places[:, 0]), _MIDDLE)
    f, deviation = Correction(1.0, choose_points(places), weights, unknown, _MIDDLE, 1, 0.0, 0.0)(places)
    assert deviation.mean() < 0.6 and left.abs().mean() < 0.3 * (0.3 * places[:, 0]).abs().mean()
    assert (f[:, 0] - 0.3 * places[:, 0]).abs().quantile(0.95) < 0.1


@given(st.floats(0.2, 5.0), st.floats(0.0, 2.0))
def test_the_gain_lies_between_1_and_what_was_measured(gain: float, deviation: float) -> None:
    predicted = torch.linspace(0.1, 1.0, 500)
    found = gain_of(predicted, gain * predicted, deviation)
    assert min(1.0, gain) - 1e-6 <= found <= max(1.0, gain) + 1e-6


def test_a_gain_of_which_nothing_is_known_is_that_of_the_frames() -> None:
    predicted = torch.linspace(0.1, 1.0, 100_000)
    assert gain_of(predicted, 1.5 * predicted, 1.0) == pytest.approx(1.5, rel=1e-3)


def test_black_frames_are_no_division_by_0() -> None:
    places = places_of(torch.zeros(50, 3), torch.zeros(50, 3), 0.5)
    weights, unknown, left = learn(choose_points(places), (places, torch.zeros(50, 1), torch.tensor([0.5]), torch.zeros(50)), _MIDDLE)
    assert all(torch.isfinite(t).all() for t in (weights, unknown, left)) and weights.abs().max() == 0
