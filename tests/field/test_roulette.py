"""Small gradients are left to chance: right in the mean, sums known to one row, and nothing that is not finite is lost."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from from_python import from_python
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from mmsynth.field.kernels.cpu import roulette

least_of, first_chance = from_python(roulette.least_of), from_python(roulette.first_chance)


@njit(error_model="numpy")
def factors(sizes: Any, least: Any, chance: Any, out: Any) -> None:
    for i in range(len(sizes)):
        out[i], chance = roulette.play(sizes[i], least, chance)


def _played(sizes: np.ndarray, least: float, chance: float) -> np.ndarray:
    out = np.full(len(sizes), np.nan, np.float32)
    factors(sizes, np.float32(least), np.float32(chance), out)
    return out


_sizes = st.lists(st.floats(0, 1, width=32), min_size=1, max_size=60).map(lambda sizes: np.array(sizes, np.float32))


@settings(deadline=None)
@given(_sizes, st.floats(0.0078125, 2, width=32))
def test_the_mean_over_all_chances_is_right(sizes: np.ndarray, least: float) -> None:
    draws = np.stack([_played(sizes, least, (k + 0.5) / 512) for k in range(512)]).astype(np.float64)
    assert np.all(draws[:, sizes >= least] == 1)
    # of 512 chances that are evenly spaced one row takes its share to within two, of those that there are between rounded sums
    assert np.all(np.abs((draws > 0).mean(axis=0) - np.minimum(sizes / least, 1)) < 2 / 512 + 1e-5)
    kept = draws * sizes
    small = (draws > 0) & (sizes < least)
    np.testing.assert_allclose(kept[small], least, rtol=1e-5)


@settings(deadline=None)
@given(_sizes, st.floats(0.0078125, 2, width=32), st.floats(0, 0.984375, width=32))
def test_a_sum_is_known_to_one_row(sizes: np.ndarray, least: float, chance: float) -> None:
    sums = np.cumsum(_played(sizes, least, chance).astype(np.float64) * sizes) - np.cumsum(sizes.astype(np.float64))
    assert np.all(np.abs(sums) < least * 1.001)


def test_what_is_not_finite_stays() -> None:
    for bad in (math.nan, math.inf):
        sizes = np.array([0.1, bad, 1e-6, 3.0], np.float32)
        least = least_of(sizes, 4, np.float32(0.3))
        assert not math.isfinite(least)
        assert _played(sizes, least, first_chance(np.float32(least)))[1] == 1
    assert np.all(_played(np.array([math.nan, math.inf], np.float32), 0.5, 0.2) == 1)


def test_of_a_share_of_nothing_all_stay() -> None:
    sizes = np.array([0.0, 1e-30, 0.5, 2.0], np.float32)
    assert np.all(_played(sizes, least_of(sizes, 4, np.float32(0)), 0.7) == 1)
    assert np.all(_played(sizes[:1], least_of(sizes[:1], 1, np.float32(0.3)), 0.7) == 1)


def test_the_least_is_a_share_of_the_root_mean_square_of_what_is_not_zero() -> None:
    values = np.random.default_rng(0).normal(size=200).astype(np.float32)
    values[::3] = 0
    assert least_of(values, 150, np.float32(0.25)) == pytest.approx(0.25 * np.sqrt(np.mean(values[:150][values[:150] != 0] ** 2)), rel=1e-5)


def test_chance_begins_anywhere() -> None:
    begins = np.array([first_chance(np.float32(x)) for x in np.random.default_rng(1).random(4000)])
    assert begins.min() >= 0 and begins.max() < 1
    counts, _ = np.histogram(begins, 20, (0, 1))
    assert np.sum((counts - 200) ** 2 / 200) < 43.8  # chi squared of 19 degrees of freedom: 0.1 % are above
