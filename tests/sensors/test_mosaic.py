"""Mosaics of any pattern, against OpenCV, kornia and colour-demosaicing."""

import cv2
import kornia
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mmsynth.sensors import filters
from mmsynth.sensors.mosaic import (
    BAYER,
    channel_map,
    channels_of,
    crop_pattern,
    demosaic,
    demosaic_edge_aware,
    grey_of,
    mosaic,
    mosaic_mask,
    photosites_of,
)

RGGB = np.array([[0, 1], [1, 2]])
POL = np.array([[2, 1], [3, 0]])
MULTISPECTRAL = np.array([[4, 5, 6], [2, 1, 0], [3, 8, 7]])
PATTERNS = [RGGB, POL, MULTISPECTRAL, np.array([[0]]), np.array([[0, 1, 2]]), np.arange(16).reshape(4, 4)]
# the pattern's letters, and kornia's name for it
NAMES = {
    "RGGB": (((0, 1), (1, 2)), kornia.color.CFA.BG),
    "BGGR": (((2, 1), (1, 0)), kornia.color.CFA.RG),
    "GRBG": (((1, 0), (2, 1)), kornia.color.CFA.GB),
    "GBRG": (((1, 2), (0, 1)), kornia.color.CFA.GR),
}


def _picture(height: int = 24, width: int = 32) -> np.ndarray:
    """(3, H, W) float32: smooth colours and an edge."""
    v, u = np.mgrid[:height, :width]
    smooth = np.stack([0.5 + 0.3 * np.sin(u / 5 + c) * np.cos(v / 6 - c) for c in range(3)])
    return (smooth * np.where(u + 0.4 * v > 20, 1.0, 0.5)).astype(np.float32)


def test_pattern_starts_at_the_first_pixel_and_repeats() -> None:
    index = channel_map(MULTISPECTRAL, 5, 7)
    assert index[0, 0] == 4 and index[1, 2] == 0 and index[4, 6] == 2 and index.shape == (5, 7)


@given(row=st.integers(0, 9), column=st.integers(0, 9), height=st.integers(1, 9), width=st.integers(1, 9), which=st.integers(0, 5))
def test_a_crop_has_the_pattern_of_where_it_was_cut(row: int, column: int, height: int, width: int, which: int) -> None:
    pattern = PATTERNS[which]
    whole = channel_map(pattern, 20, 20)[row : row + height, column : column + width]
    np.testing.assert_array_equal(channel_map(pattern, height, width, (row, column)), whole)
    np.testing.assert_array_equal(channel_map(crop_pattern(pattern, (row, column)), height, width), whole)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("shape", [(12, 15), (1, 7), (5, 1)])
def test_mosaic_and_mask_are_what_the_pattern_says(pattern: np.ndarray, shape: tuple[int, int]) -> None:
    channels = int(pattern.max()) + 1
    image = torch.rand(2, 3, channels, *shape)
    raw, mask = mosaic(image, pattern, (1, 2)), mosaic_mask(pattern, *shape, (1, 2))
    index = channel_map(pattern, *shape, (1, 2))
    for v, u in np.ndindex(*shape):
        assert torch.equal(raw[..., v, u], image[..., index[v, u], v, u])
        assert mask[:, v, u].nonzero().tolist() == [[index[v, u]]]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_demosaic_keeps_measured_values_and_constants(pattern: np.ndarray) -> None:
    raw = torch.rand(2, 12, 15)
    out = demosaic(raw, pattern, (1, 0))
    assert out.shape == (2, pattern.max() + 1, 12, 15)
    assert torch.equal(mosaic(out, pattern, (1, 0)), raw)
    torch.testing.assert_close(demosaic(raw[1], pattern, (1, 0)), out[1])
    flat = (torch.arange(1, int(pattern.max()) + 2) / 10)[:, None, None].expand(-1, 9, 11)
    torch.testing.assert_close(demosaic(mosaic(flat, pattern), pattern), flat, rtol=1e-6, atol=0)


def test_demosaic_of_a_bayer_frame_equals_bilinear() -> None:
    oracle = pytest.importorskip("colour_demosaicing")
    raw = np.random.default_rng(1).random((20, 24)).astype(np.float32)
    for name, (pattern, _) in NAMES.items():
        expected = np.moveaxis(oracle.demosaicing_CFA_Bayer_bilinear(raw, name), -1, 0)
        np.testing.assert_allclose(demosaic(torch.from_numpy(raw), np.array(pattern))[:, 2:-2, 2:-2], expected[:, 2:-2, 2:-2], atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_bayer_patterns_are_those_of_kornia_and_opencv(name: str) -> None:
    """Their names are those of the pixels (1, 1) and (1, 2), ours of (0, 0) on: the frame that each makes, and reads, is the same."""
    pattern, cfa = NAMES[name]
    image = torch.from_numpy(_picture())
    raw = mosaic(image, np.array(pattern))
    torch.testing.assert_close(kornia.color.rgb_to_raw(image[None], cfa)[0, 0], raw)
    theirs = kornia.color.raw_to_rgb(raw[None, None], cfa)[0]
    torch.testing.assert_close(demosaic(raw, np.array(pattern))[:, 2:-2, 2:-2], theirs[:, 2:-2, 2:-2], atol=1e-5, rtol=0)
    code = getattr(cv2, f"COLOR_Bayer{cfa.name}2RGB")
    opencv = cv2.demosaicing(np.round(raw.numpy() * 65535).astype(np.uint16), code) / 65535.0
    np.testing.assert_allclose(
        demosaic(raw, np.array(pattern)).numpy()[:, 2:-2, 2:-2], np.moveaxis(opencv, -1, 0)[:, 2:-2, 2:-2], atol=3e-5
    )
    assert BAYER[pattern] == getattr(cv2, f"COLOR_Bayer{cfa.name}2RGB_EA")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("offset", [(0, 0), (1, 0), (0, 1), (3, 5)])
def test_the_edge_aware_method_keeps_each_channel_in_its_place(name: str, offset: tuple[int, int]) -> None:
    pattern = np.array(NAMES[name][0])
    image = _picture(60, 80)
    raw = mosaic(torch.from_numpy(image), pattern, offset)
    out = demosaic_edge_aware(raw.numpy(), pattern, offset)
    error = np.abs(out - image)[:, 4:-4, 4:-4].mean()
    wrong = np.abs(out[::-1] - image)[:, 4:-4, 4:-4].mean()
    assert error < 0.01 and wrong > 10 * error
    bilinear = np.abs(demosaic(raw, pattern, offset).numpy() - image)[:, 4:-4, 4:-4].mean()
    assert error < bilinear


def test_the_edge_aware_method_is_for_bayer_alone() -> None:
    with pytest.raises(ValueError, match="none of Bayer's"):
        demosaic_edge_aware(np.zeros((8, 8), np.float32), POL)


def test_frame_smaller_than_its_tile() -> None:
    out = demosaic(torch.tensor([[0.5, 0.25]]), MULTISPECTRAL)
    assert out[4, 0, 0] == 0.5 and out[5, 0, 1] == 0.25
    assert torch.isnan(out[8]).all()  # never measured


@settings(max_examples=10, deadline=None)
@given(which=st.integers(0, 5))
def test_gradients(which: int) -> None:
    pattern = PATTERNS[which]
    image = torch.rand(int(pattern.max()) + 1, 6, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: mosaic(x, pattern), image)
    raw = torch.rand(6, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: demosaic(x, pattern), raw)


@pytest.mark.parametrize("pattern", [[[0, 1], [1, 2]], [[4, 5, 6], [2, 1, 0], [3, 8, 7]], [[0, 1]]])
def test_a_frame_demosaicked_by_bands_is_the_frame_demosaicked(pattern: list[list[int]], monkeypatch: pytest.MonkeyPatch) -> None:
    frame, tile = np.random.default_rng(0).random((47, 13)), np.array(pattern)
    whole = demosaic(torch.from_numpy(frame), tile).movedim(0, -1).numpy()
    monkeypatch.setattr(filters, "_BAND", 1)
    np.testing.assert_allclose(channels_of(frame, tile), whole, atol=1e-14)


@pytest.mark.parametrize("pattern", [[[0, 1], [1, 2]], [[4, 5, 6], [2, 1, 0], [3, 8, 7]], [[0, 1]], [[0, 1, 2, 2], [3, 1, 0, 3]]])
def test_grey_of_a_mosaic(pattern: list[list[int]], monkeypatch: pytest.MonkeyPatch) -> None:
    """All channels weigh alike, whatever photosites they have: exact on what changes evenly, and a grey picture stays as it is."""
    tile = np.array(pattern)
    v, u = np.mgrid[:47, :13]
    picture = np.stack([0.1 + 0.2 * c + (0.01 + 0.003 * c) * u + (0.02 - 0.004 * c) * v for c in range(int(tile.max()) + 1)], -1)
    monkeypatch.setattr(filters, "_BAND", 1)
    grey = grey_of(photosites_of(picture, tile), tile)
    inside = (slice(max(tile.shape) - 1, 1 - max(tile.shape)),) * 2
    np.testing.assert_allclose(grey[inside], picture.mean(-1)[inside], atol=1e-12)
    np.testing.assert_allclose(grey_of(np.full((47, 13), 0.3), tile), 0.3, atol=1e-14)
    frame = np.random.default_rng(0).random((47, 13))
    if tile.size == len(np.unique(tile)) and tile.shape[0] == tile.shape[1]:
        np.testing.assert_allclose(grey_of(frame, tile)[inside], channels_of(frame, tile).mean(-1)[inside], atol=1e-14)
    np.testing.assert_array_equal(grey_of(picture, None), picture.mean(-1))


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 7), (4, 2)])
def test_a_frame_of_a_file_that_is_smaller_than_its_tile(shape: tuple[int, int]) -> None:
    frame = np.random.default_rng(0).random(shape).astype(np.float32)
    for pattern in PATTERNS:
        expected = demosaic(torch.from_numpy(frame), pattern).movedim(0, -1).numpy()
        np.testing.assert_allclose(channels_of(frame, pattern), expected, rtol=1e-6)
