"""What an actual frame knows that the field does not: a gain at every pixel, and a residual colour.

The frame and the field's rendering of it are compared photosite by photosite, never demosaicked:

* ``exposure``: the one factor between them, which belongs to the frame and not to the scene.
* ``gain`` g(x): the least squares factor of the rendering in a small window, weighted by the noise of each photosite, with the prior
  g = 1 ± τ. τ is how far frame and rendering differ beyond noise (empirical Bayes): a field that is right already is left alone.
* ``residual_colour``: what of the frame g times the rendering does not explain, per channel, smoothed and shrunk by how much of it is
  noise.

Edges that the field has out of place, shading and sharpness it has missed are the same in all modalities: another one is multiplied by g
(``ratio``), or by g^β where it varies less than the source does: paint that infrared does not see has β = 0 (``gain_exponent``, learned
from the field's own renderings). The residual colour goes into another modality by a local linear map between the two, learned from the
same renderings and shrunk to the whole picture's (``guided``).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mmsynth.field.picture import bands
from mmsynth.scene.scene import Sensor
from mmsynth.sensors.filters import box_mean, by_bands, gaussian_mean
from mmsynth.sensors.mosaic import channels_of, photosites_of

# of a photosite whose sensor nobody calibrated: shot noise of 10,000 electrons at full scale, and a floor
SHOT, FLOOR = 1e-4, 1e-6
_WINDOW = 0.5  # px, standard deviation: a photosite and its direct neighbours
_COLOUR_WINDOW = 1.5
_POWER_WINDOW = 9
_MAP_RADIUS, _MAP_RIDGE = 4, 1e-3
_PLAIN = 0.005  # variance of logarithms below which a window is plain
_DARK = 0.02
_UNEXPLAINED = 0.35  # relative residual colour, or a gain beyond (1 + _UNEXPLAINED)^±3, that nothing in the field explains


@dataclass(frozen=True)
class Guide:
    """A measured frame compared with its rendering (H, W).

    Attributes:
        exposure: factor of the whole frame. gain: (H, W), 1 = as rendered. gain_sd: its posterior standard deviation.
        residual_colour: (H, W, C), in the field's exposure. prior_sd: τ.
        unexplained: (H, W) bool, where the frame shows what the field does not have.
    """

    exposure: float
    gain: np.ndarray
    gain_sd: np.ndarray
    residual_colour: np.ndarray
    prior_sd: float
    unexplained: np.ndarray


def guide(raw: np.ndarray, rendered: np.ndarray, sensor: Sensor, valid: np.ndarray) -> Guide:
    """Compare a frame with the field's rendering of it.

    Args:
        raw: (H, W) of a mosaic, else (H, W, C), linear. rendered: (H, W, C). valid: (H, W) bool, where the lens has a ray.
    """
    if sensor.mosaic is None:
        seen, clear, used = raw.astype(np.float64), rendered, np.broadcast_to(valid[..., None], rendered.shape)
    else:
        seen, clear, used = raw[..., None].astype(np.float64), photosites_of(rendered, sensor.mosaic)[..., None], valid[..., None]
    expected = np.where(valid[..., None], clear, 0.0).astype(np.float64)
    # a clipped value says "at least": nothing where the rendering says as much
    used = used & (seen < sensor.saturation)
    variance = SHOT * np.maximum(expected, 0.0) + FLOOR
    weight = np.where(used, 1.0 / variance, 0.0)
    exposure = _exposure(seen, expected, weight)
    expected, variance = exposure * expected, exposure**2 * variance
    weight = weight / exposure**2
    # τ² from what is left beyond noise, robust against things that are not in the field
    difference = np.where(used, seen - expected, 0.0)
    prior = _prior(difference, expected, variance, used)
    window = lambda x: gaussian_mean(x, _WINDOW) / _centre(_WINDOW)
    power, product = window((weight * expected**2).sum(-1)), window((weight * seen * expected).sum(-1))
    precision = power + 1.0 / prior**2
    gain = (product + 1.0 / prior**2) / precision
    left = difference - (gain[..., None] - 1.0) * expected
    colour, unexplained = _residual_colour(left, expected, variance, used, sensor, gain)
    return Guide(exposure, np.where(valid, gain, 1.0), precision**-0.5, colour / exposure, prior, unexplained & valid)


def _centre(sigma: float) -> float:
    """What a single value keeps under the filter: sums over the window, in units of it."""
    impulse = np.zeros((9, 9))
    impulse[4, 4] = 1.0
    return float(gaussian_mean(impulse, sigma)[4, 4])


def _exposure(seen: np.ndarray, expected: np.ndarray, weight: np.ndarray) -> float:
    """Median over photosites of the ratio, brighter ones counting more; 1 where there is nothing to compare.

    It errs by 0.04 % of 16,000 photosites; calibration needs short frames to be surer and trims sums instead (``calibrate_noise``).
    """
    good = (weight > 0) & (expected > 0.01)
    if good.sum() < 16:
        return 1.0
    ratio, w = seen[good] / expected[good], expected[good]
    order = np.argsort(ratio)
    return float(max(ratio[order][np.searchsorted(np.cumsum(w[order]), 0.5 * w.sum())], 1e-6))


def _prior(difference: np.ndarray, expected: np.ndarray, variance: np.ndarray, used: np.ndarray) -> float:
    """τ: of (seen - expected) / expected beyond noise; 98 % of the pixels, the others may be something new."""
    square, noise, power = difference[used] ** 2, variance[used], expected[used] ** 2
    if len(square) < 16 or not power.sum() > 0:
        return 1e-3
    near = square <= np.quantile(square, 0.98)
    return float(np.sqrt(np.clip((square[near] - noise[near]).sum() / power[near].sum(), 1e-6, 0.25)))


def _residual_colour(
    left: np.ndarray, expected: np.ndarray, variance: np.ndarray, used: np.ndarray, sensor: Sensor, gain: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The residual colour at every pixel (H, W, C) float32, and where it is too large to be an error of the field."""
    tile = (1, 1) if sensor.mosaic is None else sensor.mosaic.shape
    reach = max(tile) + 2 * int(4.0 * _COLOUR_WINDOW + 0.5) + _POWER_WINDOW // 2
    judged = by_bands(functools.partial(_colour_of, sensor), (left, expected, variance, used, gain), reach, tile[0])
    return judged[..., :-1], judged[..., -1] > 0.5


def _colour_of(
    sensor: Sensor, left: np.ndarray, expected: np.ndarray, variance: np.ndarray, used: np.ndarray, gain: np.ndarray
) -> np.ndarray:
    """(H, W, C + 1) float32: the residual colour, and 1 where it is too large."""
    known = np.where(used, left, 0.0)
    full = channels_of(known if sensor.mosaic is None else known[..., 0], sensor.mosaic)
    noise = np.broadcast_to(variance, full.shape)
    smooth = lambda x: gaussian_mean(x, _COLOUR_WINDOW)
    low = smooth(full)
    # of independent values a window of σ leaves 1 / (4 π σ²) of the variance; a mosaic has fewer of each channel
    tile = 1 if sensor.mosaic is None else sensor.mosaic.size
    noise_left = smooth(noise) * min(1.0, tile / (4.0 * np.pi * _COLOUR_WINDOW**2))
    power = box_mean(low**2, _POWER_WINDOW)
    colour = low * np.clip(1.0 - noise_left / np.maximum(power, 1e-12), 0.0, 1.0)
    if full.shape[-1] == 1:
        colour = np.zeros_like(colour)  # one channel has no colour
    level = smooth(np.maximum(expected, 0.0).mean(-1, keepdims=True))[..., 0] + 0.02
    far = np.abs(np.log(np.clip(gain, 1e-3, 1e3))) > 3.0 * np.log1p(_UNEXPLAINED)
    return np.dstack([colour, far | (np.abs(low).max(-1) > _UNEXPLAINED * level)]).astype(np.float32)


def gain_exponent(source: np.ndarray, target: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """β(x), (H, W, K) float32 in [0, 1]: by how much the logarithm of each target channel varies with that of the source's mean, around
    each pixel, in the field's own renderings; 1 where nothing varies, and light is what could.

    Args:
        source: (H, W, C). target: (H, W, K).
    """
    return by_bands(_exponent, (source, target, valid), _MAP_RADIUS)


def _exponent(source: np.ndarray, target: np.ndarray, valid: np.ndarray) -> np.ndarray:
    log = lambda a: np.log(np.maximum(np.where(valid[..., None], a, 0.0), 0.0).astype(np.float64) + _DARK)
    x, y = log(source.mean(-1, keepdims=True)), log(target)
    mean = lambda a: box_mean(a, 2 * _MAP_RADIUS + 1)
    mx, my = mean(x), mean(y)
    share = (mean(x * y) - mx * my + _PLAIN) / (mean(x * x) - mx * mx + _PLAIN)
    return np.clip(share, 0.0, 1.0).astype(np.float32)


def mapped_colour(source: np.ndarray, target: np.ndarray, valid: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """A source's residual colour (H, W, C) in the target's channels, (H, W, K) float32: by how these vary with the source's around each
    pixel, in the field's own renderings.

    Ridge regression in windows of 9 x 9 pixels, shrunk to the map of the whole picture where a window is plain (the guided filters of
    OpenCV and kornia shrink it to 0, and keep the map to themselves).

    Args:
        source: (H, W, C). target: (H, W, K).
    """
    xx, yx, count = 0.0, 0.0, int(valid.sum())
    for rows in bands(valid.shape):
        x, y = (a[rows][valid[rows]].astype(np.float64) for a in (source, target))
        xx, yx = xx + x.T @ x, yx + y.T @ x
    ridge = _MAP_RIDGE * np.eye(source.shape[-1])
    whole = np.linalg.solve(xx + ridge * count, np.transpose(yx)).T

    def mapped(source: np.ndarray, target: np.ndarray, valid: np.ndarray, colour: np.ndarray) -> np.ndarray:
        x, y = (np.where(valid[..., None], a, 0.0).astype(np.float64) for a in (source, target))
        mean = lambda a: box_mean(a, 2 * _MAP_RADIUS + 1)
        mx, my = mean(x), mean(y)
        of_x = mean(x[..., :, None] * x[..., None, :]) - mx[..., :, None] * mx[..., None, :]
        of_both = mean(y[..., :, None] * x[..., None, :]) - my[..., :, None] * mx[..., None, :]
        # the map (K, C) of each pixel is (of_both + ridge whole) (of_x + ridge)⁻¹, and of_x is symmetric
        turned = np.linalg.solve(of_x + ridge, colour[..., None].astype(np.float64))
        return ((of_both + _MAP_RIDGE * whole) @ turned)[..., 0].astype(np.float32)

    return by_bands(mapped, (source, target, valid, colour), _MAP_RADIUS)
