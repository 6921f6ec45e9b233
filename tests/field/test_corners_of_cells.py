"""Corners of cells as vectors over positions, and what positions of one cell add to a table."""

import numpy as np
import pytest
import torch
from from_python import from_python

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import reference
from mmsynth.field.kernels.constants import FEATURES, FIRST_FEATURE_ROW, HASH_PRIMES
from mmsynth.field.kernels.cpu import blocks, corners
from mmsynth.field.kernels.cpu.arrays import as_arrays
from mmsynth.field.kernels.cpu.corners import AT_ONCE, same_cell

encode_block, scatter_block, find_corners = map(from_python, (blocks.encode_block, blocks.scatter_block, corners.find_corners))
CORNERS = np.array([[c >> 2 & 1, c >> 1 & 1, c & 1] for c in range(8)])


def _found(unit: np.ndarray, resolution: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows (8, n) of positions (n, 3) in [0, 1], and their fractions (3, n)."""
    n = len(unit)
    axes, fractions = np.zeros((3, AT_ONCE), np.float32), np.zeros((3, AT_ONCE), np.float32)
    places = np.zeros((8, AT_ONCE), np.uint32)
    axes[:, :n] = unit.T
    find_corners(np.int64(n), axes.reshape(-1), np.int64(resolution), rows, places.reshape(-1), fractions.reshape(-1))
    return places[:, :n] // (4 * FEATURES), fractions[:, :n]


@pytest.mark.parametrize("n", [1, 15, 17, AT_ONCE])
@pytest.mark.parametrize(("resolution", "rows"), [(6, 343), (6, 512), (7, 64), (90, 4096)])
def test_rows_are_those_of_the_formula(resolution: int, rows: int, n: int) -> None:
    """Müller et al. 2022, eq. 4, in whole numbers; borders belong to the last cells."""
    unit = np.random.default_rng(0).random((n, 3), np.float32)
    unit[0] = [0.0, 1.0, 1.0]
    found, fractions = _found(unit, resolution, rows)
    cell = np.minimum((unit * np.float32(resolution)).astype(np.int64), resolution - 1)
    x, y, z = (cell[None] + CORNERS[:, None]).transpose(2, 0, 1)
    dense = (resolution + 1) ** 3 <= rows
    hashed = (x * HASH_PRIMES[0] ^ y * HASH_PRIMES[1] ^ z * HASH_PRIMES[2]) % rows
    np.testing.assert_array_equal(found, (x * (resolution + 1) + y) * (resolution + 1) + z if dense else hashed)
    np.testing.assert_allclose(fractions, (unit * np.float64(resolution) - cell).T, atol=1e-5)


@pytest.mark.parametrize(("resolution", "rows"), [(6, 343), (9, 16), (300, 4096)])
def test_four_corners_tell_whether_all_are_the_same(resolution: int, rows: int) -> None:
    """Also where few rows let corners of different cells collide."""
    unit = np.random.default_rng(1).random((AT_ONCE, 3), np.float32)
    unit[::2] = unit[1::2] + np.float32(0.01 / resolution)
    found, _ = _found(np.clip(unit, 0, 1), resolution, rows)
    places = found.astype(np.uint32).reshape(-1)
    same = np.array([[same_cell(places, i, j) for j in range(AT_ONCE)] for i in range(AT_ONCE)])
    np.testing.assert_array_equal(same, (found[:, :, None] == found[:, None, :]).all(0))
    assert AT_ONCE + AT_ONCE // 2 < same.sum() < AT_ONCE**2 / 2


@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_what_positions_of_one_cell_add_is_what_each_adds(extent: float) -> None:
    """Runs of a cell, as the taps of a point and the sections of a ray are, across the ends of what is found at once; in float64."""
    torch.manual_seed(0)
    grid = HashGrid(3, 10, 4, 40, extent)
    grid.table.data.normal_()
    positions = extent * (2.1 * torch.rand(60, 3) - 1.05).repeat_interleave(5, 0) + 1e-3 * torch.randn(300, 3)
    block = np.zeros((300, FIRST_FEATURE_ROW + grid.width), np.float32)
    block[:, :3], at = positions.numpy(), as_arrays(grid.at(3))._replace(table=grid.table.detach().numpy())
    encode_block(block, 300, at)
    table = grid.table.detach().double().requires_grad_()
    expected = reference.encode(positions.double(), kernels.GridTable(table, grid.resolutions, grid.offsets, extent, 3))
    np.testing.assert_allclose(block[:, FIRST_FEATURE_ROW:], expected.detach().numpy(), atol=1e-4)
    pull = torch.randn(300, grid.width)
    pull[::7] = 0.0
    block[:, FIRST_FEATURE_ROW:] = pull.numpy()
    expected.backward(pull.double())
    gradient = np.zeros_like(grid.table.detach().numpy())
    for level in range(3):
        scatter_block(block, 300, at, gradient, level)
    assert table.grad is not None
    np.testing.assert_allclose(gradient, table.grad.numpy(), atol=1e-3)
