"""The photon transfer curve: a sensor's noise figures from raw frames and what they were expected to be (EMVA 1288).

    σ_y² = K² σ_d² + 1 / 12 + K (μ_y - black) + PRNU² (μ_y - black)²

Two ways. ``photon_transfer`` trusts the expectation (a flat field, the truth of a rendered scene): the noise is raw - expected.
``photon_transfer_of_frames`` does not: what a fitted field expects is off by as much as the noise. It takes differences between
neighbouring photosites of one channel, and uses the expectation only for the local brightness and its variation.

Both are maximum likelihood, see ``noise_likelihood``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.sensors.filters import box_mean
from mmsynth.sensors.mosaic import photosites_of
from mmsynth.sensors.noise_likelihood import TEXTURE, Estimate, Name, Parameters, Values, estimate_of, most_likely, outlier_variance

UNCLIPPED = 0.98
"""Of white: values below it are what the photosite measured."""

_ACTIVITY = (1.25, 2.5, 5.0, 10.0, 30.0)  # expected square differences, in variances, up to which a surface counts, the plainest first
_PLAIN, _LEAST_PLAIN = 10.0, 1000  # there must be as many whose expected square difference is below as many variances
_TEXTURE_OFF = 0.025  # of the gain, times 1 for the plainest surfaces, 2 for the next, ..: as measured on fitted scenes with a truth
_SEEN = 3.0  # deviations of its square from which a PRNU is one: with fewer, one of forty fits takes chance for it
_MOST = 400_000  # values of a fit
_LEAST = 200
_WINDOW, _BLOCK = 3, 32
_MEDIAN_OF_SQUARE = 0.45494  # of a standard normal value
_BINS = 32

_START = Parameters(constant=float(np.log(4.0)), slope=0.0, square=-12.0, variation=float(np.log(0.3)), outliers=-3.0)


@dataclass(frozen=True)
class PhotonTransfer:
    """Noise figures of a sensor from the variance of its raw values, each with its standard deviation.

    A read noise or PRNU that cannot be measured (no dark pixels, no pattern) is 0. Its deviation is then the detection limit: the value
    whose square is two (PRNU: three) deviations of the square.

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


def photon_transfer(raw: np.ndarray, expected: np.ndarray, bits: int, black_dn: float = 0.0, seed: int = 0) -> PhotonTransfer:
    """Fit the photon transfer equation to raw values and what they are expected to be.

    A value at an end of the converter is taken as censored: "at most" or "at least".

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
    given = Values(
        raw - expected, np.zeros(len(raw)), expected - black_dn, np.zeros(len(raw)), bound, number, number, np.zeros(len(raw), np.int64)
    )
    _check(given)
    p = replace(_START, slope=_first_slope(given, 1))
    chosen, wide = _drawn(given, seed), TEXTURE
    free: tuple[Name, ...] = ("constant", "slope", "square", "outliers")
    for _ in range(6):
        wide = outlier_variance(p, chosen, wide)
        p = most_likely(p, chosen, 1, free, wide)
    estimate = estimate_of(p, chosen, 1, free, wide)
    square, spread = float(np.exp(p.square)), float(np.exp(p.square) * estimate.covariance_of("square") ** 0.5)
    if square > _SEEN * spread:
        return _result(estimate, chosen, 1, black_dn, square**0.5, 0.5 * spread / square**0.5)
    # no use for it: the others are told better without
    free = ("constant", "slope", "outliers")
    p = most_likely(replace(p, square=-np.inf), chosen, 1, free, wide)
    return _result(estimate_of(p, chosen, 1, free, wide), chosen, 1, black_dn, 0.0, float(np.sqrt(_SEEN * spread)))


def photon_transfer_of_frames(
    frames: Sequence[tuple[np.ndarray, np.ndarray]], pattern: np.ndarray, bits: int, black_dn: float = 0.0, seed: int = 0
) -> PhotonTransfer:
    """Noise figures from raw frames and a model's renderings of them.

    The values are second differences a - 2 b + c of photosites one tile of the mosaic apart, along rows and columns. PRNU is what
    differences at one place have in common in several frames, E[d_i d_j] = 6 PRNU² μ_i μ_j, where that is more than three times its
    deviation.

    Texture that the model does not have counts as noise, so smooth places are preferred. There are five degrees of smoothness; the one
    is taken whose gain has the least total deviation. That has three parts: the sandwich estimator over blocks of 32 x 32 photosites
    (differences share photosites, and errors of the model are local), the difference to the estimate at the next degree, and 2.5 % for
    each degree.

    Limits: texture as fine as photosites is not told from noise. Where all bright places have it, the gain is up to a sixth too large and
    the read noise up to two fifths too small, and the deviations do not show it. Frames that were rendered from another field have such
    grain everywhere: their gains come out 1.1 to 2 times too large. Read noise can only be measured where it is a good part of the noise,
    in frames of short exposure.

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
    joined = Values(*(np.concatenate([getattr(d, f.name) for d in found]) for f in fields(Values)))
    joined = joined[joined.mean > 0]
    _check(joined)
    p = replace(_START, slope=_first_slope(joined, 6), square=-np.inf)
    free: tuple[Name, ...] = ("constant", "slope", "variation", "outliers")
    for _ in range(3):
        # noise of pixels near black is cut off there
        variance = p.variance(joined.mean)
        usable = joined[(joined.activity < _ACTIVITY[-1] * variance) & (joined.mean + black_dn > 3.0 * np.sqrt(variance))]
        _check(usable)
        plain = _without_foreseen(p, usable)
        prnu, prnu_sd = _response_pattern(plain, p.variance(plain.mean))
        p = most_likely(replace(p, square=2.0 * float(np.log(prnu)) if prnu > 0 else -np.inf), _drawn(plain, seed), 6, free)
    flatness = usable.activity / p.variance(usable.mean)
    if (count := int((flatness < _PLAIN).sum())) < _LEAST_PLAIN:
        raise InputError(
            f"photon transfer: {count} differences on plain surfaces, expected at least {_LEAST_PLAIN}; what these frames show is "
            "textured everywhere, give others."
        )
    fits: list[tuple[Estimate, Values]] = []
    for most in _ACTIVITY:
        chosen = usable[flatness < most]
        if len(chosen.value) >= _LEAST_PLAIN:
            chosen = _drawn(_without_foreseen(p, chosen), seed)
            fits.append((estimate_of(most_likely(p, chosen, 6, free), chosen, 6, free), chosen))
    # how far it hangs on texture is what the next less plain surfaces say differently
    others = [fits[i + 1 if i + 1 < len(fits) else i - 1][0].parameters for i in range(len(fits))]
    deviations = [
        math.hypot(estimate.covariance_of("slope") ** 0.5, estimate.parameters.slope - other.slope, _TEXTURE_OFF * (step + 1))
        if _grows(estimate.parameters)
        else math.inf
        for step, ((estimate, _), other) in enumerate(zip(fits, others, strict=True))
    ]
    best = int(np.argmin(deviations))
    return _with_texture(_result(*fits[best], 6, black_dn, prnu, prnu_sd), deviations[best], others[best])


def _differences(raw: np.ndarray, expected: np.ndarray, pattern: np.ndarray, white: float, black: float, frame: int) -> Values:
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
    return Values(
        value=second(raw),
        foreseen=second(expected),
        mean=twice(expected[v, u] - black),
        activity=twice(activity[v, u]),
        bound=np.full(2 * len(v), np.nan),
        place=np.concatenate([place, place + raw.size]),
        region=twice(v // _BLOCK * 10_000 + u // _BLOCK),
        frame=np.full(2 * len(v), frame),
    )


def _without_foreseen(p: Parameters, d: Values) -> Values:
    """Differences less the share of the expected ones that explains most: 1 of a perfect model, 0 of a rough one."""
    weight = 1.0 / (6.0 * p.variance(d.mean) + np.exp(p.variation) * d.activity)
    power = float((weight * d.foreseen**2).sum())
    share = float(np.clip((weight * d.value * d.foreseen).sum() / power, 0.0, 1.0)) if power > 0 else 0.0
    return replace(d, value=d.value - share * d.foreseen)


def _check(values: Values) -> None:
    if len(values.value) < _LEAST:
        raise InputError(f"photon transfer: {len(values.value)} usable values, expected at least {_LEAST}.")
    low, high = np.quantile(values.mean, (0.02, 0.98))
    if high < 2.0 * low:
        raise InputError("photon transfer: the values have no range of light, expected bright and dark ones.")


def _drawn(values: Values, seed: int) -> Values:
    count = len(values.value)
    return values if count <= _MOST else values[np.random.default_rng(seed).choice(count, _MOST, replace=False)]


def _first_slope(values: Values, factor: int) -> float:
    """Log of K as the plainest tenth of the values suggests."""
    variation = values.activity / values.mean
    plain = variation <= np.quantile(variation, 0.1)
    return float(np.log(np.median(values.value[plain] ** 2 / values.mean[plain]) / (factor * _MEDIAN_OF_SQUARE) + 1e-6))


def _response_pattern(d: Values, variance: np.ndarray) -> tuple[float, float]:
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


def _result(estimate: Estimate, d: Values, factor: int, black_dn: float, prnu: float, prnu_sd: float) -> PhotonTransfer:
    p = estimate.parameters
    if not _grows(p):
        raise InputError("photon transfer: the variance does not grow with light, expected shot noise.")
    constant, gain = np.exp([p.constant, p.slope])
    # of the square of the read noise in DN, by its information where it is 0, where the logarithm has no bound
    spread = max(float(constant * estimate.covariance_of("constant") ** 0.5), _spread_at_zero(p, d, factor))
    told = constant > 2.0 * spread
    slope = estimate.covariance_of("slope")
    read = float(constant**0.5 / gain)
    # the curve: bins of as many values each, on plain surfaces; their variance by the median of squares
    plain = d[d.activity < 4.0 * p.variance(d.mean)] if factor > 1 else d
    parts = [part for part in np.array_split(np.argsort(plain.mean), _BINS) if len(part) >= 30]
    relative = estimate.covariance_of("constant") / 4.0 - estimate.covariance_of("constant", "slope") + slope
    return PhotonTransfer(
        gain_dn_e=float(gain),
        gain_sd=float(gain * slope**0.5),
        read_e=read if told else 0.0,
        read_sd=float(read * max(relative, 0.0) ** 0.5) if told else float((2.0 * spread) ** 0.5 / gain),
        prnu=prnu,
        prnu_sd=prnu_sd,
        mean_dn=np.array([plain.mean[part].mean() + black_dn for part in parts]),
        variance_dn2=np.array([np.median(plain.value[part] ** 2) / (_MEDIAN_OF_SQUARE * factor) for part in parts]),
    )


def _grows(p: Parameters) -> bool:
    """Whether there is shot noise."""
    return bool(np.exp(p.slope) > 1e-5)


def _with_texture(found: PhotonTransfer, share: float, other: Parameters) -> PhotonTransfer:
    """The same figures; the gain is known to a share of it, and the read noise deviates by what another estimate says, too."""
    read = float(np.exp(0.5 * other.constant - other.slope))
    read_sd = math.hypot(found.read_sd, found.read_e - read) if found.read_e > 0 else max(found.read_sd, read)
    return replace(found, gain_sd=found.gain_dn_e * share, read_sd=read_sd)


def _spread_at_zero(p: Parameters, d: Values, factor: int) -> float:
    """Standard deviation of the variance's constant and slope told together, [DN²]: by Fisher's information, normal values."""
    basis = np.stack([np.ones_like(d.mean), d.mean], 1) / p.variance(d.mean)[:, None]
    overlap = 1.0 if factor == 1 else 4.0  # second differences along two axes share photosites
    return float(np.sqrt(np.linalg.inv(0.5 * basis.T @ basis / overlap)[0, 0]))
