"""Drawing photosites: random numbers, what is drawn how often, and the kernel against its definition."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from mmsynth.field import kernels
from mmsynth.field.kernels import reference
from mmsynth.field.kernels.drawing import random_bits, scramble
from mmsynth.fitting.tiles import Tile, Tiled, all_pixels, joined, selection_of, some_pixels

SHAPES = [(13, 21), (40, 33), (40, 33)]  # of the cameras of three modalities: frames that are no multiple of tiles, nor of nodes
TILES = [Tile(8, 4), Tile(8, 8), Tile(16, 16)]
FRAMES = [3, 2, 2]
i32 = lambda values: torch.tensor(values, dtype=torch.int32)


def _scene(seed: int = 0) -> tuple[kernels.Frames, kernels.Cameras, kernels.Modalities]:
    """Frames of three kinds: a mosaic of codes of 8 and 16 bits, colours with alpha in some frames, and a polarization in floats."""
    random = np.random.default_rng(seed)
    stored = [
        random.integers(0, 256, (13, 21, 1), np.uint8), random.integers(0, 65536, (13, 21, 1), np.uint16),
        random.random((13, 21, 1), np.float32), random.integers(0, 256, (40, 33, 4), np.uint8),
        random.integers(0, 65536, (40, 33, 3), np.uint16), random.random((40, 33, 4), np.float32),
        random.integers(0, 256, (40, 33, 4), np.uint8),
    ]  # fmt: skip
    kinds = [np.uint8, np.uint16, np.float32]
    flat = [np.pad(x.reshape(-1).view(np.uint8), (0, -x.nbytes % 4)) for x in stored]
    begins = np.cumsum([0, *map(len, flat)])
    data = torch.from_numpy(np.concatenate(flat))
    of_frame = np.repeat(np.arange(3), FRAMES)
    tiles = [int(np.prod(TILES[m].down_across(*SHAPES[m]))) for m in of_frame]
    first_tile, first_frame = np.cumsum([0, *tiles]), np.cumsum([0, *FRAMES])
    rotations = np.linalg.qr(random.normal(size=(7, 3, 3)))[0].astype(np.float32)
    frames = kernels.Frames(
        torch.tensor([b // x.itemsize for b, x in zip(begins, stored, strict=False)]), i32([kinds.index(x.dtype.type) for x in stored]),
        i32([x.shape[2] for x in stored]), i32(of_frame), i32(first_tile[:-1]), torch.from_numpy(rotations),
        torch.from_numpy(random.normal(size=(7, 3)).astype(np.float32)), data, data.view(torch.uint16), data.view(torch.float32),
    )  # fmt: skip
    steps, down, across = [1, 8, 1], [13, 6, 40], [21, 5, 33]
    nodes = [np.stack([*np.meshgrid(0.02 * s * np.arange(a) - 0.3, 0.02 * s * np.arange(d) - 0.4), np.ones((d, a))], -1).reshape(-1, 3)
             for s, d, a in zip(steps, down, across, strict=True)]  # fmt: skip
    nodes = [n / np.linalg.norm(n, axis=1, keepdims=True) for n in nodes]
    cameras = kernels.Cameras(
        i32([s[1] for s in SHAPES]), i32(steps), torch.tensor(np.cumsum([0, *map(len, nodes)])[:-1]), i32(across), i32(down),
        torch.from_numpy(np.concatenate(nodes).astype(np.float32)),
    )  # fmt: skip
    angles = np.deg2rad([0, 45, 90, 135])
    modalities = kernels.Modalities(
        i32(first_frame), i32(first_tile[first_frame]), i32([t.width for t in TILES]), i32([t.height for t in TILES]), i32([1, 3, 4]),
        i32([0, 3, 6]), i32([0, -1, -1]), i32([2, 0, 0]), i32([2, 0, 0]), i32([0, 1, 1, 2]), torch.tensor([0.2, 0.4, 0.8]),
        torch.tensor([0.9, 0.95, torch.inf]), torch.tensor([torch.nan, 1.0, torch.nan]), i32([-1, -1, 0]),
        torch.from_numpy(np.stack([np.cos(angles), np.sin(angles)], -1).astype(np.float32)),
    )  # fmt: skip
    return frames, cameras, modalities


def _selection(seed: int, share: float | None) -> tuple[kernels.Selection, list[np.ndarray]]:
    """Even draws of all pixels, or of a share of those of the first two modalities; and of each modality which, (F, H, W)."""
    random, parts, chosen = np.random.default_rng(seed), [], []
    for shape, tile, count in zip(SHAPES, TILES, FRAMES, strict=True):
        here = np.ones((count, *shape), bool)
        if share is None or len(parts) == 2:
            parts.append(all_pixels([shape] * count, tile))
        else:
            here = random.random(here.shape) < share
            here[0, 0, 0] = True
            parts.append(joined([some_pixels(x, tile) for x in here]))
        chosen.append(here)
    return selection_of(parts, _scene()[2].first_tile), chosen


# --- random numbers


def test_scrambling_is_one_to_one_and_takes_every_bit_on() -> None:
    numbers = torch.arange(1 << 20)
    scrambled = scramble(numbers)
    assert len(scrambled.unique()) == len(numbers) and scrambled.max() < 1 << 32
    for bit in range(32):
        flipped = scramble(numbers[:4096] ^ (1 << bit)) ^ scrambled[:4096]
        share = np.unpackbits(flipped.numpy().astype(np.uint32).view(np.uint8)).mean()
        assert abs(share - 0.5) < 0.02, bit  # half of the bits turn
    assert all(int(scramble(torch.tensor(x))) == _lowbias32(x) for x in (0, 1, 2**31, 2**32 - 1))  # in Python's whole numbers


def _lowbias32(x: int) -> int:
    x = (x ^ (x >> 16)) * 0x7FEB352D % 2**32
    x = (x ^ (x >> 15)) * 0x846CA68B % 2**32
    return x ^ (x >> 16)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_random_numbers_are_even_and_independent(seed: int) -> None:
    """Over rays, over steps, and of the purposes of a ray: 64 cells of one and 16 x 16 of two, by chi squared; and no lag correlates."""
    keys = np.random.default_rng(seed).integers(0, 1 << 32, (64, 2)).tolist()
    number = torch.arange(4096)
    bits = torch.stack(
        [torch.stack([random_bits((a, b), number, p) for p in range(3)]) for a, b in keys]
    ).numpy()  # (steps, purposes, rays)
    least = []
    for purpose in range(3):
        least.append(stats.chisquare(np.bincount((bits[:, purpose] >> 26).ravel(), minlength=64)).pvalue)
        least.append(stats.chisquare(np.bincount((bits[:, purpose] & 63).ravel(), minlength=64)).pvalue)
        for other in (np.roll(bits[:, purpose], 1, axis=0), np.roll(bits[:, purpose], 1, axis=1)):  # the step, the ray before
            pair = (bits[:, purpose] >> 28) * 16 + (other >> 28)
            least.append(stats.chisquare(np.bincount(pair.ravel(), minlength=256)).pvalue)
    for one, other in combinations(range(3), 2):
        pair = (bits[:, one] >> 28) * 16 + (bits[:, other] >> 28)
        least.append(stats.chisquare(np.bincount(pair.ravel(), minlength=256)).pvalue)
        assert abs(np.corrcoef(bits[:, one].ravel(), bits[:, other].ravel())[0, 1]) < 0.01
    assert min(least) * len(least) > 1e-3, least


def test_steps_whose_keys_are_near_share_no_numbers() -> None:
    """One word of a key may come near that of another step; the other then tells them apart."""
    one, other = (set(random_bits(key, torch.arange(4096), 0).tolist()) for key in ((5, 77), (6, 78)))
    assert len(one & other) < 5


# --- what is drawn


@pytest.mark.parametrize("share", [None, 0.3])
def test_all_chosen_pixels_are_drawn_alike_and_no_others(share: float | None) -> None:
    frames, cameras, modalities = _scene()
    selection, chosen = _selection(1, share)
    rays = [40_000, 0, 0]
    drawn = kernels.draw(frames, cameras, modalities, selection, rays, (1, 2))
    # the direction at a pixel of the first camera, which has a node for each, tells it
    inverse = torch.einsum("nji,nj->ni", frames.rotation[drawn.frame], drawn.directions)
    at = torch.round((inverse[:, :2] / inverse[:, 2:] + torch.tensor([0.3, 0.4])) / 0.02).long()
    seen = np.zeros(chosen[0].shape, int)
    np.add.at(seen, (drawn.frame.numpy(), at[:, 1].numpy(), at[:, 0].numpy()), 1)
    assert (seen[~chosen[0]] == 0).all()
    assert stats.chisquare(seen[chosen[0]]).pvalue > 1e-3
    np.testing.assert_allclose(drawn.ray_weight, 1.0, rtol=1e-5)
    assert stats.kstest(drawn.jitter.numpy(), "uniform").pvalue > 1e-3 and drawn.jitter.max() < 1


def test_weights_are_a_mean_over_the_modalities_that_are_drawn() -> None:
    selection, _ = _selection(1, None)
    for rays in ([5, 7, 9], [0, 7, 9], [0, 7, 0]):
        drawn = kernels.draw(*_scene(), selection, rays, (1, 2))
        assert float(drawn.measured.weight.sum()) == pytest.approx(1.0, rel=1e-4)
        assert len(drawn.origins) == sum(rays) and len(drawn.measured.axes) == 4 * rays[2]


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), key=st.tuples(*[st.integers(0, 2**32 - 1)] * 2), rays=st.tuples(*[st.integers(0, 150)] * 3),
    share=st.sampled_from([None, 0.01, 0.5]), evenly=st.floats(0.1, 1.0),
)  # fmt: skip
def test_the_kernel_draws_what_its_definition_says(
    seed: int, key: tuple[int, int], rays: tuple[int, int, int], share: float | None, evenly: float
) -> None:
    tables = _scene()
    selection, _ = _selection(seed, share)
    residual = torch.from_numpy(np.random.default_rng(seed).random(len(selection.pixels), np.float32))
    ends, weight = kernels.odds(residual, selection.pixels, tables[2].first_tile, evenly)
    of_reference = reference.odds(residual, selection.pixels, tables[2].first_tile, evenly)
    assert (ends - of_reference[0]).abs().max() <= 1  # sums in another order
    torch.testing.assert_close(weight, of_reference[1], rtol=1e-4, atol=0)
    selection = selection._replace(ends=ends, weight=weight)
    ours, theirs = (draw(*tables, selection, list(rays), key) for draw in (kernels.draw, reference.draw))
    for name in ("origins", "directions", "jitter", "alpha", "ray_weight", "tile", "frame"):
        _same(getattr(ours, name), getattr(theirs, name))
    for name in kernels.Measured._fields:
        _same(getattr(ours.measured, name), getattr(theirs.measured, name))


def _same(ours: torch.Tensor, theirs: torch.Tensor) -> None:
    """Whole numbers, stored values and random ones to the bit; what is computed in single precision within its rounding."""
    assert ours.dtype == theirs.dtype and ours.shape == theirs.shape
    torch.testing.assert_close(ours, theirs, rtol=0, atol=4e-7 if ours.is_floating_point() else 0, equal_nan=True)


def test_the_same_rays_at_any_number_of_threads(use_threads: Callable[[int], None]) -> None:
    selection, _ = _selection(3, 0.5)
    found = []
    for threads in (1, 2, 5):
        use_threads(threads)
        found.append(kernels.draw(*_scene(), selection, [999, 333, 111], (4, 5)))
    assert all(torch.equal(a.tile, b.tile) and torch.equal(a.directions, b.directions) for a, b in combinations(found, 2))


def test_a_tile_without_a_pixel_is_never_drawn() -> None:
    first_tile = i32([0, 3])
    selection = selection_of([Tiled(np.array([0, 5, 0], np.int32), None)], first_tile)
    assert selection.ends.tolist() == [0, 1 << 32, 1 << 32] and selection.weight.tolist() == [0.0, 1.0, 0.0]
