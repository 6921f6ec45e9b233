"""Channel patterns: which channel each photosite of a raw frame measures.

A pattern is an integer matrix with ``channel = pattern[row % h][column % w]``, origin at pixel (0, 0) of the sensor. Frames are
(..., H, W), images of all channels (..., C, H, W). A frame that is a crop begins at ``offset`` = (row, column) of the sensor.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from mmsynth.sensors.filters import by_bands

_LEAST_NORM = 1e-6  # weight of the photosites around one; below it there are none
BAYER = {  # channels 0, 1, 2 = red, green, blue, and OpenCV's name of the pattern: that of the pixels (1, 1) and (1, 2)
    ((0, 1), (1, 2)): cv2.COLOR_BayerBG2RGB_EA,
    ((2, 1), (1, 0)): cv2.COLOR_BayerRG2RGB_EA,
    ((1, 0), (2, 1)): cv2.COLOR_BayerGB2RGB_EA,
    ((1, 2), (0, 1)): cv2.COLOR_BayerGR2RGB_EA,
}


def pattern_of(given: Any) -> np.ndarray:
    """A pattern (h, w) int64 from nested lists. Raises ValueError: how it is wrong; not a matrix, or channels left out."""
    try:
        pattern = np.asarray(given)
    except ValueError:
        pattern = np.empty(0)
    if pattern.ndim != 2 or pattern.size == 0 or pattern.dtype.kind not in "iu":
        raise ValueError("expected rows of one length, a matrix of channel numbers")
    present = np.unique(pattern)
    if not np.array_equal(present, np.arange(len(present))):
        raise ValueError(f"holds the channels {present.tolist()}, expected 0 to {len(present) - 1}")
    return pattern.astype(np.int64)


def crop_pattern(pattern: np.ndarray, offset: tuple[int, int]) -> np.ndarray:
    """The pattern of a frame that begins at (row, column) ``offset`` of the sensor."""
    return np.roll(pattern, (-offset[0], -offset[1]), (0, 1))


def channel_map(pattern: np.ndarray, height: int, width: int, offset: tuple[int, int] = (0, 0)) -> np.ndarray:
    """(H, W) int64: the channel each photosite measures."""
    rows = (np.arange(height)[:, None] + offset[0]) % pattern.shape[0]
    columns = (np.arange(width)[None, :] + offset[1]) % pattern.shape[1]
    return pattern[rows, columns]


def mosaic_mask(pattern: np.ndarray, height: int, width: int, offset: tuple[int, int] = (0, 0)) -> Tensor:
    """(C, H, W) bool: whether a photosite measures a channel."""
    index = torch.from_numpy(channel_map(pattern, height, width, offset).astype(np.int64))
    return index == torch.arange(int(pattern.max()) + 1)[:, None, None]


def mosaic(image: Tensor, pattern: np.ndarray, offset: tuple[int, int] = (0, 0)) -> Tensor:
    """All channels (..., C, H, W) → raw frame (..., H, W): each photosite keeps its own channel. Differentiable."""
    index = torch.from_numpy(channel_map(pattern, image.shape[-2], image.shape[-1], offset).astype(np.int64)).to(image.device)
    return image.gather(-3, index.expand(*image.shape[:-3], 1, *index.shape))[..., 0, :, :]


def demosaic(raw: Tensor, pattern: np.ndarray, offset: tuple[int, int] = (0, 0)) -> Tensor:
    """Raw frame (..., H, W) → (..., C, H, W) by normalised convolution, for any pattern. Differentiable.

    For previews, comparisons and training on demosaicked images only: it invents two thirds and more of what it returns, and a raw
    frame is never demosaicked to be trained on. Each channel is the tent-weighted mean of its own photosites (Knutsson and Westin
    1993), measured values kept as they are; bilinear for a Bayer pattern (kornia's is for
    Bayer alone, and equal but at the border). NaN where a channel was never measured.
    """
    height, width = raw.shape[-2:]
    present = mosaic_mask(pattern, height, width, offset).to(raw.device)
    channels, weight = present.shape[0], present.to(raw.dtype)
    frames = raw.reshape(-1, 1, height, width)
    size = max(pattern.shape)
    tent = torch.from_numpy(_tent(size)).to(raw)

    def blur(images: Tensor) -> Tensor:
        flat = images.reshape(-1, 1, height, width)
        flat = torch.nn.functional.conv2d(flat, tent[None, None, :, None], padding=(size - 1, 0))
        return torch.nn.functional.conv2d(flat, tent[None, None, None, :], padding=(0, size - 1)).reshape(images.shape)

    total, norm = blur(torch.where(present, frames, 0.0)), blur(weight[None])
    # a corner farther than one tile from any photosite of the channel exists only in frames smaller than a tile
    mean = torch.where(present, frames, 0.0).sum((-2, -1), keepdim=True) / weight.sum((-2, -1), keepdim=True)
    filled = torch.where(norm > _LEAST_NORM, total / norm.clamp(min=_LEAST_NORM), mean)
    return torch.where(present, frames, filled).reshape(*raw.shape[:-2], channels, height, width)


def _tent(size: int) -> np.ndarray:
    """Weights (2 size - 1,) of the photosites within a tile of so many along an axis."""
    return 1.0 - np.abs(np.arange(-size + 1, size)) / size


def photosites_of(image: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """``mosaic`` of a picture as files and renderings have it: (H, W, C) → (H, W)."""
    return mosaic(torch.from_numpy(image).movedim(-1, 0), pattern).numpy()


def channels_of(frame: np.ndarray, pattern: np.ndarray | None) -> np.ndarray:
    """``demosaic`` of a frame as files have it, by OpenCV's filters: (H, W) → (H, W, C); without a pattern it has all channels already."""
    if pattern is None:
        return frame
    rows, reach, channels = pattern.shape[0], max(pattern.shape), np.arange(int(pattern.max()) + 1)

    def of_band(band: np.ndarray) -> np.ndarray:
        present = channel_map(pattern, *band.shape)[..., None] == channels
        own = np.where(present, band[..., None], band.dtype.type(0))
        norm = _blurred(present.astype(band.dtype), reach)
        with np.errstate(invalid="ignore"):  # 0 / 0: never measured
            mean = own.sum((0, 1)) / present.sum((0, 1))
        filled = np.where(norm > _LEAST_NORM, _blurred(own, reach) / np.maximum(norm, _LEAST_NORM), mean)
        return np.where(present, own, filled).astype(band.dtype, copy=False)

    # all of a full-size frame at once takes ten times the memory of what it gives
    return by_bands(of_band, (frame,), reach, rows)


def grey_of(frame: np.ndarray, pattern: np.ndarray | None) -> np.ndarray:
    """(H, W), the mean of all channels, of a frame as files have it: a tent-weighted mean of the photosites around, in which all channels
    weigh alike; the mean of what ``channels_of`` gives where each channel is measured once in a square tile, within the frame."""
    if pattern is None:
        return np.asarray(frame.mean(-1))
    share = (1.0 / np.bincount(pattern.ravel())).astype(frame.dtype)
    rows, reach = pattern.shape[0], max(pattern.shape)

    def of_band(band: np.ndarray) -> np.ndarray:
        weight = share[channel_map(pattern, *band.shape)]
        return np.asarray(_blurred(weight * band, reach) / _blurred(weight, reach))

    return by_bands(of_band, (frame,), reach, rows)


def _blurred(images: np.ndarray, size: int) -> np.ndarray:
    """(H, W) or (H, W, C), times the weights of ``_tent`` along both axes; nothing beyond the border."""
    tent = _tent(size)
    return cv2.sepFilter2D(images, -1, tent, tent, borderType=cv2.BORDER_CONSTANT).reshape(images.shape)


def is_bayer(pattern: np.ndarray) -> bool:
    """Whether a pattern is one of Bayer's four, of red, green and blue as channels 0, 1, 2."""
    return tuple(map(tuple, pattern.tolist())) in BAYER


def demosaic_edge_aware(raw: np.ndarray, pattern: np.ndarray, offset: tuple[int, int] = (0, 0)) -> np.ndarray:
    """Bayer frame (H, W) in [0, 1] → (3, H, W) float32 by OpenCV's edge-aware method, in its 16 bits.

    Sharper than ``demosaic`` at edges of grey objects; for Bayer patterns of red, green and blue as channels 0, 1, 2 alone.

    Raises:
        ValueError: another pattern.
    """
    key = tuple(map(tuple, crop_pattern(pattern, offset).tolist()))
    if key not in BAYER:
        raise ValueError(f"pattern {key} is none of Bayer's")
    frame = np.round(np.clip(raw, 0.0, 1.0) * 65535.0).astype(np.uint16)
    return np.moveaxis(cv2.demosaicing(frame, BAYER[key]).astype(np.float32) / 65535.0, -1, 0)
