"""Where rays go: as often as residuals ask for, and without a bias of what is learned."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from mmsynth.fitting.importance import Importance
from mmsynth.fitting.tiles import Tiled, selection_of


def _importance(counts: list[np.ndarray], evenly: float) -> Importance:
    """Of modalities whose tiles have so many pixels."""
    first_tile = torch.tensor(np.cumsum([0, *map(len, counts)]), dtype=torch.int32)
    return Importance(selection_of([Tiled(c.astype(np.int32), None) for c in counts], first_tile), first_tile, evenly)


def _learned(counts: list[np.ndarray], evenly: float, seed: int, spread: float = 1.0) -> Importance:
    """Every tile was looked at many times, with residuals over ``spread`` powers of ten."""
    importance = _importance(counts, evenly)
    tiles = sum(map(len, counts))
    residual = 10.0 ** torch.from_numpy(np.random.default_rng(seed).uniform(-spread, 0.0, tiles)).float()
    for _ in range(60):
        importance.learn(torch.arange(tiles), residual)
    importance.renew()
    return importance


def _shares(importance: Importance) -> np.ndarray:
    """Of the random numbers of each tile's modality."""
    first, ends = importance.first_tile.tolist(), importance.selection.ends.numpy()
    return np.concatenate([np.diff(ends[a:b], prepend=0) for a, b in itertools.pairwise(first)]) / 2.0**32


@settings(max_examples=40, deadline=None)
@given(
    counts=st.lists(st.lists(st.integers(0, 64), min_size=1, max_size=60).filter(any), min_size=1, max_size=3),
    evenly=st.floats(0.05, 1.0),
    seed=st.integers(0, 1000),
)
def test_weighted_rays_stand_for_every_pixel_alike(counts: list[list[int]], evenly: float, seed: int) -> None:
    """Probability of a pixel times weight is one over their number, of each modality for itself; no ray weighs more than 1 / evenly."""
    tiles = [np.array(c) for c in counts]
    importance = _learned(tiles, evenly, seed)
    share, weight, residual = _shares(importance), importance.selection.weight.numpy(), importance.residuals.numpy().astype(np.float64)
    assert weight.max() <= 1.001 / evenly
    for begin, end, count in zip(importance.first_tile[:-1], importance.first_tile[1:], tiles, strict=True):
        own, pixels = slice(begin, end), count.sum()
        assert share[own].sum() == 1.0 and (share[own][count == 0] == 0).all()
        np.testing.assert_allclose(share[own] * weight[own], count / pixels, rtol=1e-6)
        wanted = count * (evenly / pixels + (1.0 - evenly) * residual[own] / (residual[own] * count).sum())
        np.testing.assert_allclose(share[own], wanted, atol=1e-8)


def test_billions_of_pixels_are_drawn_from() -> None:
    """Each of 2^18 tiles keeps its share of 32 random bits, and weights make up for the rest."""
    importance = _importance([np.full(2**18, 9537)], 0.5)  # 2.5e9 pixels
    np.testing.assert_allclose(importance.selection.weight, 1.0, rtol=1e-3)
    importance.learn(torch.arange(2**18), torch.zeros(2**18))
    importance.renew()
    assert importance.selection.weight.max() <= 2.001
    np.testing.assert_allclose((_shares(importance) * importance.selection.weight.numpy()), 2.0**-18, rtol=1e-6)


def test_all_evenly_is_as_without() -> None:
    counts = [np.array([32, 7, 0, 64])]
    importance, even = _learned(counts, 1.0, 3), _importance(counts, 1.0)
    assert torch.equal(importance.selection.ends, even.selection.ends) and torch.equal(importance.selection.weight, even.selection.weight)
    np.testing.assert_allclose(even.selection.weight, [1, 1, 0, 1], rtol=1e-6)


def test_where_nothing_was_looked_at_yet_rays_go_first() -> None:
    importance = _importance([np.full(100, 32)], 0.5)
    for _ in range(60):
        importance.learn(torch.arange(50), torch.full((50,), 0.1))
    importance.renew()
    assert _shares(importance)[50:].sum() == pytest.approx(0.5 * 0.5 + 0.5 * 1.0 / 1.1, abs=1e-4)


def test_a_model_without_a_residual_is_drawn_from_as_before() -> None:
    importance = _importance([np.array([32, 32]), np.array([5])], 0.5)
    for _ in range(1000):
        importance.learn(torch.arange(3), torch.zeros(3))
    importance.renew()
    assert importance.residuals.max() < 1e-40
    np.testing.assert_allclose(_shares(importance), [0.5, 0.5, 1.0], rtol=1e-6)
    np.testing.assert_allclose(importance.selection.weight, 1.0, rtol=1e-6)


def test_a_state_that_was_saved_draws_the_same() -> None:
    counts = [np.full(25, 32), np.array([9])]
    importance, again = _learned(counts, 0.5, 5), _importance(counts, 0.5)
    importance.learn(torch.tensor([3, 20]), torch.tensor([2.0, 3.0]))  # after the last renewal: not yet in what is drawn from
    again.load_state_dict(importance.state_dict())
    for renewed in (False, True):
        if renewed:
            importance.renew()
            again.renew()
        assert all(torch.equal(a, b) for a, b in zip(importance.selection, again.selection, strict=True))


def test_a_highlight_is_estimated_with_less_noise() -> None:
    """One pixel in fifty has a residual twenty times as large: the noise of the mean gradient of a step of 400 rays."""
    random = np.random.default_rng(0)
    residual = np.full(200, 0.05)
    residual[::50] = 1.0
    gradient = np.repeat(residual, 32) * random.choice([-1.0, 1.0], 6400)
    importance = _importance([np.full(200, 32)], 0.5)
    for _ in range(60):
        importance.learn(torch.arange(200), torch.from_numpy(residual).float())
    importance.renew()
    tile = random.choice(200, (2000, 400), p=_shares(importance))
    weighted = (gradient[32 * tile + random.integers(0, 32, tile.shape)] * importance.selection.weight.numpy()[tile]).mean(1)
    even = gradient[random.integers(0, 6400, (2000, 400))].mean(1)
    assert np.std(weighted) < 0.6 * np.std(even)
    assert abs(np.mean(weighted) - gradient.mean()) < 4 * stats.sem(weighted)
