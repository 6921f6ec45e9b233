"""How likely values are that should be noise, and the parameters that make them most likely.

Values are normal with the variance k σ²(μ) + β a² (``Parameters.variance``, k = 1, or 6 for second differences of photosites, and a² the
expected variation around), or, with a probability that is fitted too, wider: edges and texture that nobody expected.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace
from typing import Literal

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_ndtr

QUANTISATION = 1.0 / 12.0
_LOG_2PI = float(np.log(2.0 * np.pi))
_AT_ONCE = 1 << 14  # values: what is made of them stays in the cache

Name = Literal["constant", "slope", "square", "variation", "outliers"]


@dataclass(frozen=True)
class Parameters:
    """Logarithms of the variance's constant [DN²], of its slope K [DN], of its square PRNU² and of the share β of the expected
    variation; logit of the probability of outliers."""

    constant: float
    slope: float
    square: float
    variation: float
    outliers: float

    def variance(self, mean: np.ndarray) -> np.ndarray:
        """σ² [DN²] of values whose expectation is ``mean`` [DN] above black."""
        constant, gain, square = np.exp([self.constant, self.slope, self.square])
        return np.asarray(QUANTISATION + constant + gain * mean + square * mean**2)

    @property
    def outlier_probability(self) -> float:
        return float(1.0 / (1.0 + np.exp(-self.outliers)))


_NAMES = [f.name for f in fields(Parameters)]
_LOW, _HIGH = Parameters(-14.0, -14.0, -20.0, -9.0, -9.0), Parameters(16.0, 10.0, 0.0, 3.0, 0.0)


@dataclass(frozen=True)
class OutlierVariance:
    """Variance of what was not expected: ``times`` that of what was, and ``plus`` [DN²]."""

    times: float
    plus: float


TEXTURE = OutlierVariance(16.0, 0.0)


@dataclass(frozen=True)
class Estimate:
    """Parameters and the covariance of them all (5, 5), 0 where they were not free."""

    parameters: Parameters
    covariance: np.ndarray

    def covariance_of(self, one: Name, other: Name | None = None) -> float:
        """Of two parameters; of one alone: its variance."""
        return float(self.covariance[_NAMES.index(one), _NAMES.index(other or one)])


@dataclass(frozen=True)
class Values:
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

    @functools.cached_property
    def square(self) -> np.ndarray:
        return np.asarray(self.value**2)

    @functools.cached_property
    def mean_square(self) -> np.ndarray:
        return np.asarray(self.mean**2)

    @functools.cached_property
    def cut(self) -> np.ndarray:
        """Which were cut off."""
        return np.flatnonzero(np.isfinite(self.bound))

    def __getitem__(self, chosen: np.ndarray | slice) -> Values:
        return Values(*(getattr(self, f.name)[chosen] for f in fields(self)))


def outlier_variance(p: Parameters, d: Values, before: OutlierVariance) -> OutlierVariance:
    """How wide values are that are no noise: first by those beyond six deviations, then by how likely each value is one of them."""
    whole = ~np.isfinite(d.bound)
    variance = p.variance(d.mean)
    if before == TEXTURE:
        far = whole & (d.square > 36.0 * variance)
        return OutlierVariance(1.0, float(np.mean(d.square[far]))) if far.sum() >= 10 else TEXTURE
    unexpected, broader = p.outlier_probability, variance + before.plus
    narrow, broad = (_log_density(d, v, np.log(v))[0] for v in (variance, broader))
    odds = narrow + np.log1p(-unexpected) - np.log(unexpected) - broad
    likely = 1.0 / (1.0 + np.exp(np.clip(odds, -50.0, 50.0)))
    return OutlierVariance(1.0, float(np.average((d.square - variance)[whole], weights=likely[whole])))


def _log_likelihood(p: Parameters, d: Values, factor: int, wide: OutlierVariance) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(N,), its derivative by the variance (N,) and by the logit of outliers (N,), and the variance's derivatives by the others (4, N)."""
    constant, gain, square, share = np.exp([p.constant, p.slope, p.square, p.variation])
    terms = np.empty((4, len(d.mean)))
    terms[0] = factor * constant
    for row, scale, what in ((1, factor * gain, d.mean), (2, factor * square, d.mean_square), (3, share, d.activity)):
        np.multiply(what, scale, out=terms[row])
    variance = terms.sum(0) + factor * QUANTISATION
    logarithm = np.log(variance)
    unexpected = p.outlier_probability
    narrow, narrow_slope = _log_density(d, variance, logarithm)
    broader = wide.times * variance + wide.plus
    broad, broad_slope = _log_density(d, broader, np.log(broader) if wide.plus else logarithm + np.log(wide.times))
    odds = broad - narrow + (np.log(unexpected) - np.log1p(-unexpected))  # logarithm, of an outlier
    less = np.exp(-np.abs(odds))
    both = 1.0 + less
    likelihood = narrow + np.log1p(-unexpected) + np.maximum(odds, 0.0) + np.log(both)
    of_broad = np.where(odds > 0.0, 1.0, less) / both
    by_variance = narrow_slope + of_broad * (wide.times * broad_slope - narrow_slope)
    return likelihood, by_variance, of_broad - unexpected, terms


def _log_density(d: Values, variance: np.ndarray, logarithm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of normal values, and of those that were cut off the probability of that; and its derivative by the variance.

    Args:
        logarithm: of the variance.
    """
    z = d.square / variance
    density, slope = -0.5 * (z + logarithm + _LOG_2PI), 0.5 * (z - 1.0) / variance
    if len(d.cut):
        v = variance[d.cut]
        at = d.bound[d.cut] / np.sqrt(v)
        density[d.cut] = log_ndtr(at)
        slope[d.cut] = -0.5 * at / v * np.exp(-0.5 * (at**2 + _LOG_2PI) - density[d.cut])
    return density, slope


def most_likely(start: Parameters, d: Values, factor: int, free: Sequence[Name], wide: OutlierVariance = TEXTURE) -> Parameters:
    """The parameters, from a start; what is not ``free`` stays. ``factor``: k of the values, 1 or 6."""
    chosen = [_NAMES.index(name) for name in free]
    with_free = lambda x: replace(start, **dict(zip(free, x, strict=True)))

    count = len(d.value)
    parts = [d[begin : begin + _AT_ONCE] for begin in range(0, count, _AT_ONCE)]

    def cost(x: np.ndarray) -> tuple[float, np.ndarray]:
        p, total, slopes = with_free(x), 0.0, np.zeros(5)
        for part in parts:
            value, by_variance, by_outliers, terms = _log_likelihood(p, part, factor, wide)
            total += float(value.sum())
            slopes += np.append(terms @ by_variance, by_outliers.sum())
        return -total / count, -slopes[chosen] / count

    first, low, high = (np.array(astuple(p))[chosen] for p in (start, _LOW, _HIGH))
    options = {"ftol": 1e-12, "gtol": 1e-8}
    bounds = list(zip(low, high, strict=True))
    found = minimize(cost, np.clip(first, low, high), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return with_free(found.x)


def estimate_of(p: Parameters, d: Values, factor: int, free: Sequence[Name], wide: OutlierVariance = TEXTURE) -> Estimate:
    """The most likely parameters with their covariance (sandwich estimator), regions of a frame taken as independent."""
    chosen = [_NAMES.index(name) for name in free]
    _, by_variance, by_outliers, terms = _log_likelihood(p, d, factor, wide)
    scores = np.concatenate([terms * by_variance, by_outliers[None]])[chosen].T
    _, index = np.unique(d.region * (d.frame.max() + 1) + d.frame, return_inverse=True)
    per_block = np.stack([np.bincount(index, weights=s) for s in scores.T], 1)
    inverse = np.linalg.pinv(scores.T @ scores)
    covariance = np.zeros((5, 5))
    covariance[np.ix_(chosen, chosen)] = inverse @ (per_block.T @ per_block) @ inverse
    return Estimate(p, covariance)
