"""Windows over pictures (H, W, ...) with any number of channels, by OpenCV: up to three times as fast as SciPy's, equal to 5e-15.

The border is repeated. Every value is summed anew: a NaN stays within its window, and does not run through the rest of the picture as in
running sums (SciPy's ``uniform_filter``, ``cv2.blur``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from mmsynth.parallel import side_by_side

_BAND = 1 << 18  # pixels
_MOST_CHANNELS = 128  # that OpenCV 5 filters at once


def by_bands(function: Callable[..., np.ndarray], images: Sequence[np.ndarray], reach: int, tile: int = 1) -> np.ndarray:
    """``function`` of pictures (H, W, ...), each row of which depends on ``reach`` rows above and below: by bands of rows, side by side,
    so that what it computes of a full-size picture needs little memory. Bands begin at multiples of ``tile`` rows."""
    height, width = images[0].shape[:2]
    step, margin = (-(-rows // tile) * tile for rows in (max(1, _BAND // width), reach))

    def of_band(top: int) -> np.ndarray:
        first, last = max(top - margin, 0), min(top + step + margin, height)
        return function(*(image[first:last] for image in images))[top - first : top - first + step]

    found: np.ndarray | None = None
    for top, part in side_by_side(of_band, range(0, height, step)):
        found = np.empty((height, *part.shape[1:]), part.dtype) if found is None else found
        found[top : top + step] = part
    assert found is not None, "a picture without rows"
    return found


def box_mean(image: np.ndarray, size: int) -> np.ndarray:
    """Mean over ``size`` x ``size`` pixels, an odd number."""
    weights = np.full(size, 1.0 / size)
    return _separable(image, weights, weights)


def gaussian_mean(image: np.ndarray, sigma: float | tuple[float, float]) -> np.ndarray:
    """Gaussian mean, as far as 4 standard deviations; ``sigma`` in pixels, of rows and columns where there are two."""
    rows, columns = (cv2.getGaussianKernel(2 * int(4.0 * s + 0.5) + 1, s)[:, 0] for s in np.broadcast_to(sigma, 2))
    return _separable(image, rows, columns)


def _separable(image: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    flat = image.reshape(*image.shape[:2], -1)
    parts: Sequence[np.ndarray] = [flat[..., i : i + _MOST_CHANNELS] for i in range(0, flat.shape[-1], _MOST_CHANNELS)]
    found = [cv2.sepFilter2D(np.ascontiguousarray(part), -1, columns, rows, borderType=cv2.BORDER_REPLICATE) for part in parts]
    return np.dstack(found).reshape(image.shape)
