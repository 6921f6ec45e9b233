"""The photon transfer curve: a sensor's noise figures from raw frames and what they were expected to be (EMVA 1288).

    σ_y² = K² σ_d² + 1 / 12 + K (μ_y - black) + PRNU² (μ_y - black)²

Two ways. ``photon_transfer`` trusts the expectation (a flat field, the truth of a rendered scene): the noise is raw - expected.
``photon_transfer_of_frames`` does not: what a fitted field expects is off by as much as the noise. It takes differences between
neighbouring photosites of one channel, and of the expectation only how bright it is there and how much it varies.

Both are maximum likelihood: values v are normal with the variance k σ²(μ) + β a², where k = 1, or 6 for second differences, and a² is
the expected variation around; or, with a probability that is fitted too, wider (edges and texture that nobody expected).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.special import log_ndtr

from mmsynth.errors import InputError
from mmsynth.sensors.filters import box_mean
from mmsynth.sensors.mosaic import photosites_of

_QUANTISATION = 1.0 / 12.0
UNCLIPPED = 0.98
"""Of white: values below it are what the photosite measured."""

Wide = tuple[float, float]
"""Variance of what was not expected: in units of what was, and [DN²]."""

_TEXTURE: Wide = (16.0, 0.0)
_ACTIVITY = (1.25, 2.5, 5.0, 10.0, 30.0)  # expected square differences, in variances, up to which a surface counts, the plainest first
_PLAIN, _LEAST_PLAIN = 10.0, 1000  # there must be as many whose expected square difference is below as many variances
_TEXTURE_OFF = 0.025  # of the gain, times 1 for the plainest surfaces, 2 for the next, ..: as measured on fitted scenes with a truth
_SEEN = 3.0  # deviations of its square from which a PRNU is one: with fewer, one of forty fits takes chance for it
_MOST = 400_000  # values of a fit
_LEAST = 200
_WINDOW, _BLOCK = 3, 32
_MEDIAN_OF_SQUARE = 0.45494  # of a standard normal value
_BINS = 32

# what is fitted: log of constant, slope, square, share β of the expected variation; logit of the probability of outliers
_CONSTANT, _SLOPE, _SQUARE, _VARIATION, _UNEXPECTED = range(5)
_LOW, _HIGH = np.array([-14.0, -14.0, -20.0, -9.0, -9.0]), np.array([16.0, 10.0, 0.0, 3.0, 0.0])
_START = np.array([np.log(4.0), 0.0, -12.0, np.log(0.3), -3.0])


@dataclass(frozen=True)
class PhotonTransfer:
    """What the variance of raw values tells of a sensor; each figure with its standard deviation.

    A read noise or PRNU that is not told (no dark pixels, no pattern) is 0, and its deviation is what would have been seen at twice, for
    PRNU thrice, the deviation of its square.

    Attributes:
        gain_dn_e: K [DN / e-]. read_e: σ_d [e-], of all that does not depend on light. prnu: share. mean_dn, variance_dn2: the curve
            [DN, DN²], quantisation included.
    """

    gain_dn_e: float
    gain_sd: float
    read_e: float
    read_sd: float
    prnu: float
    prnu_sd: float
    mean_dn: np.ndarray
    variance_dn2: np.ndarray


@dataclass(frozen=True)
class _Values:
    """What should be noise, (N,) each.

    Attributes:
        value: [DN]. foreseen: the expectation's own. mean: expected, above black.
        activity: expected square difference of neighbours around.
        bound: NaN, or how far from the expectation the noise went at least, where it was cut off (below: negative).
        place: which photosites, the same in all frames. region: which part of the sensor that is, 32 x 32 photosites. frame: which.
    """

    value: np.ndarray
    foreseen: np.ndarray
    mean: np.ndarray
    activity: np.ndarray
    bound: np.ndarray
    place: np.ndarray
    region: np.ndarray
    frame: np.ndarray

    def __getitem__(self, chosen: np.ndarray) -> _Values:
        return _Values(*(getattr(self, f.name)[chosen] for f in fields(self)))


def photon_transfer(raw: np.ndarray, expected: np.ndarray, bits: int, black_dn: float = 0.0, seed: int = 0) -> PhotonTransfer:
    """Fit the photon transfer equation to raw values and what they are expected to be.

    A value at an end of the converter says "at most" or "at least".

    Args:
        raw: (N,) DN. expected: (N,) DN, black level included. bits: of the converter. seed: of the choice among more than 400,000.
    Raises:
        InputError: too few values, no range of light, or no noise that grows with light.
    """
    white = 2.0**bits - 1.0
    usable = np.isfinite(expected) & (expected > black_dn) & (expected < white)
    raw, expected = raw[usable].astype(np.float64), expected[usable].astype(np.float64)
    number = np.arange(len(raw))
    # rounding: all below 0.5 is 0
    bound = np.where(raw <= 0, 0.5 - expected, np.where(raw >= white, expected - (white - 0.5), np.nan))
    given = _Values(
        raw - expected, np.zeros(len(raw)), expected - black_dn, np.zeros(len(raw)), bound, number, number, np.zeros(len(raw), np.int64)
    )
    _check(given)
    theta = _START.copy()
    theta[_SLOPE] = _first_slope(given, 1)
    chosen, free = _drawn(given, seed), (_CONSTANT, _SLOPE, _SQUARE, _UNEXPECTED)
    wide = _TEXTURE
    for _ in range(6):
        wide = _of_outliers(theta, chosen, wide)
        theta = _most_likely(theta, chosen, 1, free, wide)
    covariance = _sandwich(theta, chosen, 1, free, wide)
    square, spread = float(np.exp(theta[_SQUARE])), float(np.exp(theta[_SQUARE]) * covariance[_SQUARE, _SQUARE] ** 0.5)
    if square > _SEEN * spread:
        return _result(theta, covariance, chosen, 1, black_dn, square**0.5, 0.5 * spread / square**0.5)
    # no use for it: the others are told better without
    theta[_SQUARE] = -np.inf
    theta = _most_likely(theta, chosen, 1, (_CONSTANT, _SLOPE, _UNEXPECTED), wide)
    covariance = _sandwich(theta, chosen, 1, (_CONSTANT, _SLOPE, _UNEXPECTED), wide)
    return _result(theta, covariance, chosen, 1, black_dn, 0.0, float(np.sqrt(_SEEN * spread)))


def photon_transfer_of_frames(
    frames: Sequence[tuple[np.ndarray, np.ndarray]], pattern: np.ndarray, bits: int, black_dn: float = 0.0, seed: int = 0
) -> PhotonTransfer:
    """Noise figures from raw frames and a model's renderings of them.

    The values are second differences a - 2 b + c of photosites one tile of the mosaic apart, along rows and columns. PRNU is what
    differences at one place have in common in several frames, E[d_i d_j] = 6 PRNU² μ_i μ_j, where that is more than three times its
    deviation.

    Texture that the model does not see counts as noise, the more the less plain a surface is, and plain ones are few: of surfaces plain
    to five degrees those are taken whose gain deviates least, all told. That is by blocks of 32 x 32 photosites (sandwich estimator:
    differences share photosites, and what is wrong in one place is wrong around it), by what the next less plain surfaces say
    differently, and 2.5 % for each degree. Texture as fine as photosites still leads off: where all that is bright has it, the gain is
    too large, by up to a sixth, and the read noise too small, by up to two fifths, and the deviations do not tell. Frames that were
    rendered from another field have such grain everywhere: gains 1.1 to 2 times too large. The read noise is told where it is a good
    part of the noise: by frames of short exposure.

    Args:
        frames: raw (H, W) and expected (H, W, C), all channels at every pixel, DN, black level included; NaN where unknown.
        pattern: of the mosaic; [[0]]: none.
        seed: of the choice among more than 400,000 differences.
    Raises:
        InputError: too few differences, no range of light, or no noise that grows with light.
    """
    white = 2.0**bits - 1.0
    if not frames:
        raise InputError("photon transfer: no frames, expected at least one.")
    found = [_differences(raw.astype(np.float64), e.astype(np.float64), pattern, white, black_dn, i) for i, (raw, e) in enumerate(frames)]
    joined = _Values(*(np.concatenate([getattr(d, f.name) for d in found]) for f in fields(_Values)))
    joined = joined[joined.mean > 0]
    _check(joined)
    theta = _START.copy()
    theta[_SLOPE], theta[_SQUARE] = _first_slope(joined, 6), -np.inf
    free = (_CONSTANT, _SLOPE, _VARIATION, _UNEXPECTED)
    for _ in range(3):
        # noise of pixels near black is cut off there
        variance = _variance_of(theta, joined.mean)
        usable = joined[(joined.activity < _ACTIVITY[-1] * variance) & (joined.mean + black_dn > 3.0 * np.sqrt(variance))]
        _check(usable)
        plain = _without_foreseen(theta, usable)
        prnu, prnu_sd = _response_pattern(plain, _variance_of(theta, plain.mean))
        theta[_SQUARE] = 2.0 * np.log(prnu) if prnu > 0 else -np.inf
        theta = _most_likely(theta, _drawn(plain, seed), 6, free)
    flatness = usable.activity / _variance_of(theta, usable.mean)
    if (count := int((flatness < _PLAIN).sum())) < _LEAST_PLAIN:
        raise InputError(
            f"photon transfer: {count} differences on plain surfaces, expected at least {_LEAST_PLAIN}; what these frames show is "
            "textured everywhere, give others."
        )
    fits = []
    for most in _ACTIVITY:
        chosen = usable[flatness < most]
        if len(chosen.value) >= _LEAST_PLAIN:
            chosen = _drawn(_without_foreseen(theta, chosen), seed)
            estimate = _most_likely(theta, chosen, 6, free)
            fits.append((estimate, _sandwich(estimate, chosen, 6, free), chosen))
    # how far it hangs on texture is what the next less plain surfaces say differently
    others = [fits[i + 1 if i + 1 < len(fits) else i - 1][0] for i in range(len(fits))]
    deviations = [
        math.hypot(covariance[_SLOPE, _SLOPE] ** 0.5, estimate[_SLOPE] - other[_SLOPE], _TEXTURE_OFF * (step + 1))
        if _grows(estimate)
        else math.inf
        for step, ((estimate, covariance, _), other) in enumerate(zip(fits, others, strict=True))
    ]
    best = int(np.argmin(deviations))
    return _and_off(_result(*fits[best], 6, black_dn, prnu, prnu_sd), deviations[best], others[best])


def _differences(raw: np.ndarray, expected: np.ndarray, pattern: np.ndarray, white: float, black: float, frame: int) -> _Values:
    """Of one frame (H, W); neighbours are one tile of the mosaic apart."""
    rows, columns = pattern.shape
    steps = ((rows, 0), (columns, 1))
    near = lambda image, step, axis: (np.roll(image, step, axis), np.roll(image, -step, axis))
    # of every channel at every pixel: what lies between the photosites of a channel is seen, too
    square = sum(0.5 * sum((n - expected) ** 2 for n in near(expected, step, axis)) for step, axis in steps)
    activity = photosites_of(box_mean(square, _WINDOW), pattern)
    expected = photosites_of(expected, pattern)
    usable = np.isfinite(activity) & (cv2.dilate(raw, np.ones((2 * rows + 1, 2 * columns + 1), np.uint8)) < UNCLIPPED * white)
    edge = (rows + _WINDOW // 2, columns + _WINDOW // 2)
    usable[: edge[0]] = usable[-edge[0] :] = False
    usable[:, : edge[1]] = usable[:, -edge[1] :] = False
    v, u = np.nonzero(usable)
    second = lambda image: np.concatenate([(sum(near(image, step, axis)) - 2.0 * image)[v, u] for step, axis in steps])
    place = v * raw.shape[1] + u
    twice = lambda x: np.concatenate([x, x])
    return _Values(
        value=second(raw),
        foreseen=second(expected),
        mean=twice(expected[v, u] - black),
        activity=twice(activity[v, u]),
        bound=np.full(2 * len(v), np.nan),
        place=np.concatenate([place, place + raw.size]),
        region=twice(v // _BLOCK * 10_000 + u // _BLOCK),
        frame=np.full(2 * len(v), frame),
    )


def _without_foreseen(theta: np.ndarray, d: _Values) -> _Values:
    """Differences less the share of the expected ones that explains most: 1 of a perfect model, 0 of a rough one."""
    weight = 1.0 / (6.0 * _variance_of(theta, d.mean) + np.exp(theta[_VARIATION]) * d.activity)
    power = float((weight * d.foreseen**2).sum())
    share = float(np.clip((weight * d.value * d.foreseen).sum() / power, 0.0, 1.0)) if power > 0 else 0.0
    return replace(d, value=d.value - share * d.foreseen)


def _check(values: _Values) -> None:
    if len(values.value) < _LEAST:
        raise InputError(f"photon transfer: {len(values.value)} usable values, expected at least {_LEAST}.")
    low, high = np.quantile(values.mean, (0.02, 0.98))
    if high < 2.0 * low:
        raise InputError("photon transfer: the values have no range of light, expected bright and dark ones.")


def _drawn(values: _Values, seed: int) -> _Values:
    count = len(values.value)
    return values if count <= _MOST else values[np.random.default_rng(seed).choice(count, _MOST, replace=False)]


def _first_slope(values: _Values, factor: int) -> float:
    """Log of K as the plainest tenth of the values suggests."""
    variation = values.activity / values.mean
    plain = variation <= np.quantile(variation, 0.1)
    return float(np.log(np.median(values.value[plain] ** 2 / values.mean[plain]) / (factor * _MEDIAN_OF_SQUARE) + 1e-6))


# --- likelihood


def _variance_of(theta: np.ndarray, mean: np.ndarray) -> np.ndarray:
    constant, gain, square = np.exp(theta[:3])
    return np.asarray(_QUANTISATION + constant + gain * mean + square * mean**2)


def _of_outliers(theta: np.ndarray, d: _Values, wide: Wide) -> Wide:
    """How wide values are that are no noise: first by those beyond six deviations, then by how likely each value is one of them."""
    whole = ~np.isfinite(d.bound)
    variance = _variance_of(theta, d.mean)
    if wide == _TEXTURE:
        far = whole & (d.value**2 > 36.0 * variance)
        return (1.0, float(np.mean(d.value[far] ** 2))) if far.sum() >= 10 else _TEXTURE
    unexpected = 1.0 / (1.0 + np.exp(-theta[_UNEXPECTED]))
    narrow = np.log1p(-unexpected) + _log_density(d, variance)[0]
    likely = 1.0 / (1.0 + np.exp(np.clip(narrow - np.log(unexpected) - _log_density(d, variance + wide[1])[0], -50.0, 50.0)))
    return 1.0, float(np.average((d.value**2 - variance)[whole], weights=likely[whole]))


def _log_likelihood(theta: np.ndarray, d: _Values, factor: int, wide: Wide = _TEXTURE) -> tuple[np.ndarray, np.ndarray]:
    """(N,) and its gradient (N, 5)."""
    constant, gain, square, share = np.exp(theta[:4])
    terms = np.stack([np.full_like(d.mean, factor * constant), factor * gain * d.mean, factor * square * d.mean**2, share * d.activity], 1)
    variance = terms.sum(1) + factor * _QUANTISATION
    unexpected = 1.0 / (1.0 + np.exp(-theta[_UNEXPECTED]))
    log_narrow, narrow_slope = _log_density(d, variance)
    log_wide, wide_slope = _log_density(d, wide[0] * variance + wide[1])
    explained, not_explained = np.log1p(-unexpected) + log_narrow, np.log(unexpected) + log_wide
    both = np.logaddexp(explained, not_explained)
    of_wide = np.exp(not_explained - both)
    by_variance = (1.0 - of_wide) * narrow_slope + of_wide * wide[0] * wide_slope
    return both, np.concatenate([by_variance[:, None] * terms, (of_wide - unexpected)[:, None]], 1)


def _log_density(d: _Values, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of normal values, and of those that were cut off the probability of that; and its derivative by the variance."""
    z = d.value**2 / variance
    density, slope = -0.5 * z - 0.5 * np.log(2.0 * np.pi * variance), 0.5 * (z - 1.0) / variance
    cut = np.flatnonzero(np.isfinite(d.bound))
    at, v = d.bound[cut] / np.sqrt(variance[cut]), variance[cut]
    density[cut] = log_ndtr(at)
    slope[cut] = -0.5 * at / v * np.exp(-0.5 * at**2 - 0.5 * np.log(2.0 * np.pi) - density[cut])
    return density, slope


def _most_likely(theta: np.ndarray, d: _Values, factor: int, free: Sequence[int], wide: Wide = _TEXTURE) -> np.ndarray:
    """From a start; what is not free stays."""
    chosen = list(free)

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        full = theta.copy()
        full[chosen] = x
        value, gradient = _log_likelihood(full, d, factor, wide)
        return -float(value.mean()), -gradient.mean(0)[chosen]

    low, high = _LOW[chosen], _HIGH[chosen]
    options = {"ftol": 1e-12, "gtol": 1e-8}
    bounds = list(zip(low, high, strict=True))
    found = minimize(cost, np.clip(theta[chosen], low, high), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    out = theta.copy()
    out[chosen] = found.x
    return out


def _sandwich(theta: np.ndarray, d: _Values, factor: int, free: Sequence[int], wide: Wide = _TEXTURE) -> np.ndarray:
    """(5, 5) covariance of the estimate, regions of a frame taken as independent."""
    chosen = list(free)
    scores = _log_likelihood(theta, d, factor, wide)[1][:, chosen]
    _, index = np.unique(np.stack([d.region, d.frame]), axis=1, return_inverse=True)
    per_block = np.stack([np.bincount(index, weights=s) for s in scores.T], 1)
    inverse = np.linalg.pinv(scores.T @ scores)
    out = np.zeros((5, 5))
    out[np.ix_(chosen, chosen)] = inverse @ (per_block.T @ per_block) @ inverse
    return out


def _response_pattern(d: _Values, variance: np.ndarray) -> tuple[float, float]:
    """PRNU and its deviation, by products of second differences at one place in two frames."""
    plain = (d.value**2 < 25.0 * 6.0 * variance) & (d.activity < 4.0 * variance)
    d, variance = d[plain], 6.0 * variance[plain]
    _, place = np.unique(d.place, return_inverse=True)
    total = lambda x: np.bincount(place, weights=x)
    signal, power = d.value * d.mean / variance, d.mean**2 / variance
    found, weight = total(signal) ** 2 - total(signal**2), 6.0 * (total(power) ** 2 - total(power**2))
    region = np.zeros(len(found), np.int64)
    region[place] = d.region
    _, index = np.unique(region, return_inverse=True)
    products, weights = (np.bincount(index, weights=x) for x in (found, weight))
    if not weights.sum() > 0 or len(products) < 2:
        return 0.0, 1.0
    square = float(products.sum() / weights.sum())
    spread = float(np.sqrt(((products - square * weights) ** 2).sum()) / weights.sum())
    if square < _SEEN * spread:
        return 0.0, float(np.sqrt(_SEEN * spread))
    return float(np.sqrt(square)), float(0.5 * spread / np.sqrt(square))


# --- result


def _result(
    theta: np.ndarray, covariance: np.ndarray, d: _Values, factor: int, black_dn: float, prnu: float, prnu_sd: float
) -> PhotonTransfer:
    constant, gain = np.exp(theta[:2])
    if not _grows(theta):
        raise InputError("photon transfer: the variance does not grow with light, expected shot noise.")
    # of the square of the read noise in DN, by its information where it is 0, where the logarithm has no bound
    spread = max(float(constant * covariance[_CONSTANT, _CONSTANT] ** 0.5), _spread_at_zero(theta, d, factor))
    told = constant > 2.0 * spread
    slope = covariance[_SLOPE, _SLOPE]
    read = float(constant**0.5 / gain)
    relative = covariance[_CONSTANT, _CONSTANT] / 4.0 - covariance[_CONSTANT, _SLOPE] + slope
    return PhotonTransfer(
        gain_dn_e=float(gain),
        gain_sd=float(gain * slope**0.5),
        read_e=read if told else 0.0,
        read_sd=float(read * max(relative, 0.0) ** 0.5) if told else float((2.0 * spread) ** 0.5 / gain),
        prnu=prnu,
        prnu_sd=prnu_sd,
        **_curve(theta, d, factor, black_dn),
    )


def _grows(theta: np.ndarray) -> bool:
    """Whether there is shot noise."""
    return bool(np.exp(theta[_SLOPE]) > 1e-5)


def _and_off(found: PhotonTransfer, share: float, other: np.ndarray) -> PhotonTransfer:
    """The same figures; the gain is known to a share of it, and the read noise deviates by what another estimate says, too."""
    read = float(np.exp(0.5 * other[_CONSTANT] - other[_SLOPE]))
    read_sd = math.hypot(found.read_sd, found.read_e - read) if found.read_e > 0 else max(found.read_sd, read)
    return replace(found, gain_sd=found.gain_dn_e * share, read_sd=read_sd)


def _spread_at_zero(theta: np.ndarray, d: _Values, factor: int) -> float:
    """Standard deviation of the variance's constant and slope told together, [DN²]: by Fisher's information, normal values."""
    basis = np.stack([np.ones_like(d.mean), d.mean], 1) / _variance_of(theta, d.mean)[:, None]
    overlap = 1.0 if factor == 1 else 4.0  # second differences along two axes share photosites
    return float(np.sqrt(np.linalg.inv(0.5 * basis.T @ basis / overlap)[0, 0]))


def _curve(theta: np.ndarray, d: _Values, factor: int, black_dn: float) -> dict[str, np.ndarray]:
    """Mean and variance of bins of as many values each, on plain surfaces; by the median of squares."""
    plain = d[d.activity < 4.0 * _variance_of(theta, d.mean)] if factor > 1 else d
    parts = [part for part in np.array_split(np.argsort(plain.mean), _BINS) if len(part) >= 30]
    means = np.array([plain.mean[part].mean() + black_dn for part in parts])
    variances = np.array([np.median(plain.value[part] ** 2) / (_MEDIAN_OF_SQUARE * factor) for part in parts])
    return {"mean_dn": means, "variance_dn2": variances}
