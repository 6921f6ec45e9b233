"""Rectified units of the surface's network: what they give together, their gates, and all gradients from these."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from from_python import from_python
from numba import njit

from mmsynth.field.kernels.cpu import units
from mmsynth.field.kernels.cpu.units import GATES, MOST

add_of_units = from_python(units.add_of_units)


@njit(error_model="numpy")
def rectify(block: Any, turned: Any, output: Any, gates: Any, total: Any, inner: Any) -> None:
    totals, row = units.totals_of_tile(), np.int64(0)
    while row < len(total):
        some = units.rectify(block, turned, output, gates, totals, row, np.int64(len(total)), inner)
        for i in range(some):
            total[row + i] = totals[i]
        row += some


def _network(rows: int, inner: int, hidden: int) -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(rows + inner + hidden)
    return tuple(random.normal(size=size).astype(np.float32) for size in ((rows, inner + 3), (inner + 3, hidden), hidden + 1))


def _bits(gates: np.ndarray) -> np.ndarray:
    return (gates[:, :, None] >> np.arange(GATES, dtype=np.uint16) & 1).reshape(len(gates), -1).astype(bool)


@pytest.mark.parametrize(("rows", "inner", "hidden"), [(4, 4, 16), (8, 20, 32), (12, 36, 48), (132, 24, 64)])
def test_units_give_their_total_and_their_gates(rows: int, inner: int, hidden: int) -> None:
    block, turned, output = _network(rows, inner, hidden)
    gates, total = np.zeros((rows, hidden // GATES), np.uint16), np.zeros(rows, np.float32)
    rectify(block, turned, output, gates, total, inner)
    exact = block[:, :inner].astype(np.float64) @ turned[:inner]
    clear = np.abs(exact) > 1e-4  # others may be on either side
    assert np.array_equal(_bits(gates)[clear], exact[clear] > 0) and clear.mean() > 0.99
    np.testing.assert_allclose(total, np.maximum(exact, 0) @ output[:hidden], atol=1e-5 * hidden)


@pytest.mark.parametrize(("tile", "rows", "hidden"), [(units._small, 4, 64), (units._high, MOST, 48), (units._high_and_wide, MOST, 64)])
def test_all_tiles_find_the_same_bits(tile: Any, rows: int, hidden: int) -> None:
    """A CPU without AVX-512 takes the smallest alone, and comes to the same field."""
    block, turned, output = _network(MOST, 20, hidden)
    gates, total = np.zeros((MOST, hidden // GATES), np.uint16), np.zeros(MOST, np.float32)
    rectify(block, turned, output, gates, total, 20)
    found, totals = np.zeros_like(gates), np.zeros(MOST, np.float32)
    from_python(tile)(block, turned, output, found, totals, 0, 20)
    assert np.array_equal(found[:rows], gates[:rows]) and np.array_equal(totals[:rows], total[:rows])
    assert not found[rows:].any() and not totals[rows:].any()  # nothing beside


def test_what_is_not_a_number_stays_it() -> None:
    block, turned, output = _network(8, 4, 32)
    block[2, 1], turned[:3, 5] = np.nan, np.nan
    gates, total = np.zeros((8, 2), np.uint16), np.zeros(8, np.float32)
    rectify(block[:, :4], turned[:4], output, gates, total, 4)
    assert np.isnan(total).all() and _bits(gates)[2].all() and _bits(gates)[:, 5].all()


def test_gradients_follow_from_gates() -> None:
    block, turned, output = _network(40, 17, 32)
    x, hidden, last = (torch.from_numpy(a).double().requires_grad_() for a in (block[:, :20], turned[:20].T.copy(), output))
    pull = np.random.default_rng(0).normal(size=40).astype(np.float32)
    (torch.relu(x @ hidden.T) @ last[:32]).backward(torch.from_numpy(pull).double())
    gates, total = np.zeros((40, 2), np.uint16), np.zeros(40, np.float32)
    rectify(block, turned, output, gates, total, 20)
    let_through, pulls = from_python(units.let_through), np.full((40, 32), np.nan, np.float32)
    for i in range(40):
        let_through(gates, i, pull[i], pulls, i)
    assert np.array_equal(pulls, np.where(_bits(gates), pull[:, None], 0))
    g_hidden, g_output = np.zeros((32, 20), np.float32), np.zeros(33, np.float32)
    last.grad[32] = float(pull.sum())
    add_of_units(block[:, :20].T @ pulls, pull.sum(), turned[:20].T.copy(), output, g_hidden, g_output)
    np.testing.assert_allclose(g_hidden, hidden.grad, atol=1e-4)
    np.testing.assert_allclose(g_output, last.grad, atol=1e-4)
    np.testing.assert_allclose(pulls @ (output[:32, None] * turned[:20].T), x.grad, atol=1e-4)
