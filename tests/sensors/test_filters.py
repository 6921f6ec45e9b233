"""Windows over pictures: SciPy's, but for what a NaN reaches."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter

from mmsynth.sensors.filters import box_mean, gaussian_mean


@pytest.mark.parametrize("shape", [(30, 41), (30, 41, 1), (30, 41, 3), (9, 8, 12, 12), (2, 3)])
def test_windows_are_scipys(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).random(shape)
    rest = (0,) * (len(shape) - 2)
    assert np.abs(box_mean(image, 9) - uniform_filter(image, (9, 9, *rest), mode="nearest")).max() < 1e-14
    assert np.abs(gaussian_mean(image, 1.5) - gaussian_filter(image, (1.5, 1.5, *rest), mode="nearest")).max() < 1e-14
    assert np.abs(gaussian_mean(image, (3.0, 4.5)) - gaussian_filter(image, (3.0, 4.5, *rest), mode="nearest")).max() < 1e-14


def test_a_nan_stays_within_its_window() -> None:
    image = np.ones((20, 30, 2))
    image[4, 5, 0] = np.nan
    assert np.isnan(box_mean(image, 3)).sum() == 9 and np.isnan(gaussian_mean(image, 0.5)).sum() == 25
