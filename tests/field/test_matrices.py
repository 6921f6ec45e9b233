"""Products of small matrices: whatever tiles the CPU takes, the sums are the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from from_python import from_python

from mmsynth.field.kernels.cpu import matrices

add_product = from_python(matrices.add_product)


def _matrices(rows: int, inner: int, columns: int) -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(rows + inner + columns)
    return tuple(random.normal(size=size).astype(np.float32) for size in ((rows, inner), (inner, columns), (rows, columns)))


@pytest.mark.parametrize(("rows", "inner", "columns"), [(4, 1, 16), (8, 7, 32), (12, 33, 48), (132, 40, 64)])
def test_a_product_is_added(rows: int, inner: int, columns: int) -> None:
    a, b, out = _matrices(rows, inner, columns)
    expected = out + a.astype(np.float64) @ b
    add_product(a, b, out, rows, inner, columns)
    assert np.abs(out - expected).max() < 1e-5 * np.sqrt(inner)


@pytest.mark.parametrize(
    ("tile", "rows", "columns"),
    [(matrices._small, 4, 16), (matrices._wide, 4, 32), (matrices._high, 8, 16), (matrices._high_and_wide, 8, 32)],
)
def test_large_tiles_add_the_same_bits(tile: Any, rows: int, columns: int) -> None:
    """A CPU without AVX-512 takes the smallest alone, and comes to the same field."""

    a, b, out = _matrices(8, 33, 32)
    by_tiles, before = out.copy(), out.copy()
    add_product(a, b, by_tiles, 8, 33, 32)
    from_python(tile)(a, b, out, 0, a.shape[1], 0)
    assert np.array_equal(out[:rows, :columns], by_tiles[:rows, :columns])
    out[:rows, :columns] = before[:rows, :columns]
    assert np.array_equal(out, before)  # nothing beside
