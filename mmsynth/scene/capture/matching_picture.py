"""A raw frame as a grey picture in which points are found and matched. For matching alone: a field is learned from the frame itself.

A mosaic's channels are brought to one level, and every pixel becomes the mean of a window that is symmetric about it and weighs all
photosites of the pattern alike, so that the pattern goes and nothing moves. Tone: the square root of linear values, which has the
same shot noise at every brightness; pictures of 8 bits are taken to have a tone curve of their own.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import convolve1d

from mmsynth.scene.images import read_native
from mmsynth.scene.scene import Sensor
from mmsynth.sensors.mosaic import channel_map

_WHITE = 0.995  # of the pixels: what is brighter is white


def matching_picture(image: np.ndarray, sensor: Sensor) -> np.ndarray:
    """A frame as its file has it, (H, W) or (H, W, C) → (H, W) uint8."""
    values = image.astype(np.float32)
    if sensor.mosaic is not None and image.ndim == 2:
        grey = _without_pattern(values, sensor.mosaic)
    elif image.ndim == 3:
        grey = values[..., : sensor.channel_count].mean(-1)
    else:
        grey = values
    if image.dtype == np.uint8:
        return np.asarray(np.round(grey), dtype=np.uint8)
    white = float(np.quantile(grey, _WHITE))
    tone = np.sqrt(np.clip(grey / white, 0.0, 1.0)) if white > 0 else np.zeros_like(grey)
    return np.asarray(np.round(255.0 * tone), dtype=np.uint8)


def _without_pattern(values: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Levelled channels, smoothed by a tent as long as two tiles (less one photosite) in each direction."""
    channel = channel_map(pattern, *values.shape)
    means = np.bincount(channel.ravel(), values.ravel()) / np.bincount(channel.ravel())
    level = np.divide(means.mean(), means, out=np.zeros_like(means), where=means > 0)
    out = values * level[channel].astype(np.float32)
    for axis, size in enumerate(pattern.shape):
        box = np.ones(size, np.float32) / size
        out = convolve1d(out, np.convolve(box, box), axis=axis, mode="mirror")
    return np.asarray(out)


def read_matching_picture(path: object, sensor: Sensor) -> np.ndarray:
    """``matching_picture`` of a file. Raises InputError as ``read_native``."""
    return matching_picture(read_native(path), sensor)  # type: ignore[arg-type]
