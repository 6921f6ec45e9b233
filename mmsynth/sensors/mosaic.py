"""Channel patterns: which channel each photosite of a raw frame measures.

A pattern is an integer matrix with ``channel = pattern[row % h][column % w]``, origin at pixel (0, 0) of the stored frame.
"""

from __future__ import annotations

import cv2
import numpy as np


def channel_map(pattern: np.ndarray, height: int, width: int) -> np.ndarray:
    """(H, W) int64: the channel each photosite measures."""
    rows = np.arange(height)[:, None] % pattern.shape[0]
    columns = np.arange(width)[None, :] % pattern.shape[1]
    return pattern[rows, columns]


def mosaic(image: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """All channels (H, W, C) → raw frame (H, W): each photosite keeps its own channel."""
    index = channel_map(pattern, *image.shape[:2])
    return np.take_along_axis(image, index[..., None], axis=2)[..., 0]


def demosaic(raw: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Raw frame (H, W) → (H, W, C) by normalised convolution, for any pattern.

    For previews and comparisons only: a raw frame is never demosaicked to be trained on. Each channel is the
    tent-weighted mean of its own photosites (Knutsson & Westin 1993), measured values kept as they are.
    """
    height, width = raw.shape
    index = channel_map(pattern, height, width)
    size = max(pattern.shape)
    tent = 1.0 - np.abs(np.arange(-size + 1, size)) / size if size > 1 else np.ones(1)
    out = np.empty((height, width, int(pattern.max()) + 1), np.float32)
    for channel in range(out.shape[2]):
        present = (index == channel).astype(np.float32)
        total = cv2.sepFilter2D(raw.astype(np.float32) * present, cv2.CV_32F, tent, tent, borderType=cv2.BORDER_CONSTANT)
        weight = cv2.sepFilter2D(present, cv2.CV_32F, tent, tent, borderType=cv2.BORDER_CONSTANT)
        # a corner farther than one tile from any photosite of the channel exists only in frames smaller than a tile
        mean = np.float32((raw * present).sum() / present.sum()) if present.any() else np.float32(np.nan)
        out[..., channel] = np.where(present > 0, raw, np.divide(total, weight, out=np.full_like(total, mean), where=weight > 1e-6))
    return out
