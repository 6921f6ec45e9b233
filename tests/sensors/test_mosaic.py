import numpy as np
import pytest

from mmsynth.sensors.mosaic import channel_map, demosaic, mosaic

BAYER = np.array([[0, 1], [1, 2]])
MULTISPECTRAL = np.array([[4, 5, 6], [2, 1, 0], [3, 8, 7]])


def test_pattern_starts_at_the_first_pixel_and_repeats() -> None:
    index = channel_map(MULTISPECTRAL, 5, 7)
    assert index[0, 0] == 4 and index[1, 2] == 0 and index[4, 6] == 2 and index.shape == (5, 7)


@pytest.mark.parametrize("pattern", [BAYER, MULTISPECTRAL, np.array([[0]]), np.array([[0, 1, 2]])])
def test_demosaic_keeps_measured_values_and_constants(pattern: np.ndarray) -> None:
    random = np.random.default_rng(0)
    raw = random.random((12, 15)).astype(np.float32)
    out = demosaic(raw, pattern)
    np.testing.assert_array_equal(mosaic(out, pattern), raw)
    flat = np.broadcast_to(np.arange(1, pattern.max() + 2, dtype=np.float32) / 10, (9, 11, pattern.max() + 1))
    np.testing.assert_allclose(demosaic(mosaic(flat, pattern), pattern), flat, rtol=1e-6)


def test_demosaic_of_a_bayer_frame_equals_bilinear() -> None:
    oracle = pytest.importorskip("colour_demosaicing")
    raw = np.random.default_rng(1).random((20, 24)).astype(np.float32)
    expected = oracle.demosaicing_CFA_Bayer_bilinear(raw, "RGGB")
    np.testing.assert_allclose(demosaic(raw, BAYER)[2:-2, 2:-2], expected[2:-2, 2:-2], atol=1e-6)


def test_frame_smaller_than_its_tile() -> None:
    out = demosaic(np.array([[0.5, 0.25]], np.float32), MULTISPECTRAL)
    assert out[0, 0, 4] == 0.5 and out[0, 1, 5] == 0.25
    assert np.isnan(out[0, 0, 8])  # never measured
