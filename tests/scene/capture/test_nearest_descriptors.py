"""Nearest descriptors against SciPy's distances in whole numbers."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from scipy.spatial.distance import cdist

from mmsynth.scene.capture import nearest
from mmsynth.scene.capture.nearest import mutual_matches


def _by_scipy(a: np.ndarray, b: np.ndarray, ratio: float, farthest: float) -> set[tuple[int, int]]:
    """As it is defined, pair by pair."""
    squared, out = cdist(a.astype(np.float64), b.astype(np.float64), "sqeuclidean"), set()
    for i, row in enumerate(squared):
        j = int(row.argmin())
        others = min(np.delete(row, j).min(), np.delete(squared[:, j], i).min())
        if squared[:, j].argmin() == i and row[j] <= (512.0 * farthest) ** 2 and row[j] < ratio**2 * others:
            out.add((i, j))
    return out


@given(
    seed=st.integers(0, 2**32 - 1), count=st.integers(2, 40), shared=st.integers(0, 40), noise=st.integers(0, 60), most=st.integers(1, 255)
)
@settings(max_examples=60, deadline=None)
def test_matches_are_those_of_scipy(seed: int, count: int, shared: int, noise: int, most: int) -> None:
    random = np.random.default_rng(seed)
    a, b = random.integers(0, most + 1, (2, count, 128))
    some = random.permutation(count)[: min(shared, count)]
    b[: len(some)] = np.clip(a[some] + random.integers(-noise, noise + 1, (len(some), 128)), 0, 255)
    a, b = a.astype(np.uint8), b.astype(np.uint8)
    for ratio, farthest in ((0.8, 0.7), (0.95, np.inf)):
        assert {(i, j) for i, j in mutual_matches(a, b, ratio, farthest).tolist()} == _by_scipy(a, b, ratio, farthest)


def test_many_are_matched_a_part_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of 300 points are in both pictures, the brightest that bytes can tell among them."""
    random = np.random.default_rng(0)
    a, b = random.integers(0, 256, (2, 300, 128)).astype(np.uint8)
    b[:150] = a[random.permutation(300)[:150]]
    a[7] = b[11] = 255
    whole = mutual_matches(a, b)
    assert len(whole) >= 149 and [7, 11] in whole.tolist() and whole.dtype == np.uint32
    monkeypatch.setattr(nearest, "_ROWS", 64)
    np.testing.assert_array_equal(mutual_matches(a, b), whole)


@pytest.mark.parametrize(("first", "second"), [(0, 5), (5, 0), (1, 5), (5, 1)])
def test_what_has_no_second_nearest_matches_nothing(first: int, second: int) -> None:
    same = np.full((5, 128), 40, np.uint8)
    assert mutual_matches(same[:first], same[:second]).shape == (0, 2)
    assert mutual_matches(same, same).shape == (0, 2)  # all are as near
