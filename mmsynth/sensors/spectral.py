"""Channels of an imagined sensor from channels that were measured.

A virtual channel's response r_v(λ) is put together from measured responses r_m(λ), w r_m, so that the light it would have measured is
the same combination of what they measured. The weights are those of least expected error (Wiener; Pratt and Mancill, Applied Optics 15,
1976) for light whose spectrum is smooth, a random function over wavelength with Matérn's covariance of order 3/2,

    Γ(d) = (1 + √3 d / ℓ) exp(-√3 d / ℓ), d = |λ - λ'|, ℓ = SMOOTH_NM,    w = (R Γ Rᵀ + σ² diag(R Γ Rᵀ))⁻¹ R Γ r_v,

with σ the relative error of what is measured. It is this that regularises: weights that would multiply noise cost more than they gain.
ℓ is that of reflectances (correlation 0.88 at 50 nm, 0.68 at 100 nm); lamps with lines are not smooth, and worse than the residual says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mmsynth.errors import InputError
from mmsynth.sensors.sensor_file import Response

SMOOTH_NM = 150.0
MEASURED_ERROR = 0.02
RESIDUAL_LIMIT = 0.15
_STEP_NM = 2.0  # of the integrals over wavelength, or a quarter of the narrowest detail
_NEGLIGIBLE = 0.05  # of a response's peak


@dataclass(frozen=True)
class Combination:
    """A virtual channel as a combination of measured ones.

    Attributes:
        weights: (M,). residual: expected rms error of the channel's value relative to its rms, of spectra as the prior has them and
            measured values with ``MEASURED_ERROR``. noise_gain: by which factor independent relative errors of measured values arrive.
        unseen: share of the response's area at wavelengths to which no measured channel responds, and the ranges [nm] where that is.
    """

    weights: np.ndarray
    residual: float
    noise_gain: float
    unseen: float
    unseen_nm: tuple[tuple[float, float], ...]


def combine(virtual: Response, measured: Sequence[Response], relative_error: float = MEASURED_ERROR) -> Combination:
    """The weights of measured channels that make a virtual one, and how well they do. Raises ValueError: nothing measured."""
    if not measured:
        raise ValueError("no measured responses")
    ranges = np.array([r.range_nm() for r in (virtual, *measured)])
    step = min(_STEP_NM, min(r.detail_nm() for r in (virtual, *measured)) / 4.0)
    nm = np.arange(max(step, ranges[:, 0].min()), ranges[:, 1].max() + step, step)
    apart = 3.0**0.5 * np.abs(nm[:, None] - nm) / SMOOTH_NM
    prior = (1.0 + apart) * np.exp(-apart)
    r_v, r_m = virtual.at(nm), np.stack([r.at(nm) for r in measured])
    gram = r_m @ prior @ r_m.T
    cross = r_m @ prior @ r_v
    power = np.diag(gram)
    # a response to nothing has weight 0
    weights = np.linalg.solve(gram + np.diag(np.where(power > 0, relative_error**2 * power, 1.0)), cross)
    signal = float(r_v @ prior @ r_v)
    left = r_v - weights @ r_m
    gain = (float(weights**2 @ np.diag(gram)) / signal) ** 0.5
    residual = (float(left @ prior @ left) / signal + (relative_error * gain) ** 2) ** 0.5
    seen = (r_m > _NEGLIGIBLE * r_m.max(1, keepdims=True)).any(0)
    unseen = r_v * ~seen
    return Combination(weights, residual, gain, float(unseen.sum() / r_v.sum()), _ranges(nm, unseen > 0.01 * r_v.max()))


def _ranges(nm: np.ndarray, chosen: np.ndarray) -> tuple[tuple[float, float], ...]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(int)))
    return tuple((float(nm[a]), float(nm[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True))


def require_expressible(combination: Combination, where: str) -> None:
    """Refuse a channel that the measured ones cannot express.

    Raises:
        InputError: its residual is above ``RESIDUAL_LIMIT``; the sentence says what is missing.
    """
    if combination.residual <= RESIDUAL_LIMIT:
        return
    if combination.unseen > 0.05:
        ranges = " and ".join(f"{a:.0f}-{b:.0f} nm" for a, b in combination.unseen_nm)
        why = f"{combination.unseen:.0%} of its response lies where no measured channel responds, {ranges}"
    else:
        why = "the measured channels are too broad or too few for its shape"
    raise InputError(
        f"{where}: the measured channels cannot express it, with an expected error of {combination.residual:.0%} "
        f"(at most {RESIDUAL_LIMIT:.0%} is accepted): {why}."
    )
