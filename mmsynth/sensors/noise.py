"""What a sensor adds to light: noise, fixed pattern, saturation, quantisation, in the terms of EMVA 1288 (release 4).

Light is linear, 1.0 = full scale, (..., H, W) at the photosites. It becomes electrons, μ_e = light · (2^bits - 1 - black) / K, then
numbers: y = K (electrons) + black, rounded and clipped. The variance of y follows the photon transfer equation

    σ_y² = K² σ_d² + 1 / 12 + K (μ_y - black) + PRNU² (μ_y - black)²

Randomness is keyed by (seed, sensor, frame, effect): a frame does not depend on which others are made, in what order or batch, and the
fixed pattern belongs to the sensor and not to the frame.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from mmsynth.errors import InputError

_OF_THREE = 0.97334  # variance of a normal distribution cut at three standard deviations


@dataclass(frozen=True)
class NoiseModel:
    """A sensor's figures, names and units of EMVA 1288.

    Attributes:
        bits: of the converter. black_dn: black level [DN]. gain_dn_e: system gain K [DN / e-]. full_well_e: saturation capacity [e-].
        read_e: temporal dark noise σ_d [e-]. dark_e_s: dark current [e- / s], during exposure_s [s].
        row_e: noise that a row has in common [e-]. dsnu_e: spread of the dark signal between pixels [e-]. prnu: spread of their
            response, as a share of 1.
    """

    bits: int
    gain_dn_e: float
    full_well_e: float
    read_e: float = 0.0
    black_dn: float = 0.0
    dark_e_s: float = 0.0
    exposure_s: float = 0.0
    row_e: float = 0.0
    dsnu_e: float = 0.0
    prnu: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 16:
            raise InputError(f"noise: bits is {self.bits}, expected 1 to 16.")
        for name in ("gain_dn_e", "full_well_e"):
            if not getattr(self, name) > 0:
                raise InputError(f"noise: {name} is {getattr(self, name)}, expected a positive number.")
        for name in ("read_e", "black_dn", "dark_e_s", "exposure_s", "row_e", "dsnu_e", "prnu"):
            if not getattr(self, name) >= 0:
                raise InputError(f"noise: {name} is {getattr(self, name)}, expected a number of at least 0.")
        if not self.black_dn < self.white_dn:
            raise InputError(f"noise: black_dn is {self.black_dn}, expected less than full scale, {self.white_dn:g}.")

    @property
    def white_dn(self) -> float:
        """Full scale of the converter [DN]."""
        return 2.0**self.bits - 1.0

    @property
    def electrons_at_one(self) -> float:
        """Electrons of light 1.0."""
        return (self.white_dn - self.black_dn) / self.gain_dn_e


def generator(seed: int, sensor: str, effect: str, frame: int | None = None) -> torch.Generator:
    """Random numbers of one effect in one frame of a sensor; ``frame`` None: of the sensor itself."""
    key = (seed, zlib.crc32(sensor.encode()), zlib.crc32(effect.encode()), 0 if frame is None else 1 + frame)
    state = int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0])
    return torch.Generator().manual_seed(state >> 1)


def record(light: Tensor, model: NoiseModel, frames: Sequence[int], sensor: str, seed: int = 0) -> Tensor:
    """The raw frames that a sensor would have recorded.

    Args:
        light: (B, H, W) at the photosites, linear, 1.0 = full scale. frames: B ids.
    Returns:
        (B, H, W) DN, whole numbers in [0, 2^bits - 1], of light's type. Gradients pass noise and rounding as if they were not
        there, and end where the sensor is saturated or black.
    """
    shape = light.shape[-2:]
    like = {"dtype": light.dtype, "device": "cpu"}

    def normal(effect: str, frame: int | None, size: Sequence[int] = shape) -> Tensor:
        return torch.randn(size, generator=generator(seed, sensor, effect, frame), **like).to(light.device)  # type: ignore[call-overload]

    electrons = light.clamp(min=0.0) * model.electrons_at_one
    if model.prnu:
        electrons = electrons * (1.0 + model.prnu * normal("prnu", None))
    dark = torch.full(shape, model.dark_e_s * model.exposure_s, dtype=light.dtype, device=light.device)
    if model.dsnu_e:
        dark = dark + model.dsnu_e * normal("dsnu", None)
    # the dark signal's own pattern may be below its mean; what is counted cannot be below zero
    expected = (electrons + dark.clamp(min=0.0)).detach().cpu().clamp(min=0.0)
    counted = [torch.poisson(e, generator=generator(seed, sensor, "shot", frame)) for e, frame in zip(expected, frames, strict=True)]
    noise = torch.stack(counted).to(light.device) - electrons.detach() + dark.clamp(max=0.0)
    if model.read_e:
        noise = noise + model.read_e * torch.stack([normal("read", frame) for frame in frames])
    if model.row_e:
        noise = noise + model.row_e * torch.stack([normal("row", frame, (shape[0], 1)) for frame in frames])
    held = (electrons + noise).clamp(max=model.full_well_e)
    numbers = (held * model.gain_dn_e + model.black_dn).clamp(0.0, model.white_dn)
    return numbers + (torch.round(numbers) - numbers).detach()


@dataclass(frozen=True)
class PhotonTransfer:
    """What the variance of raw values tells of a sensor; each with its standard deviation.

    Attributes:
        gain_dn_e: K [DN / e-]. read_e: σ_d [e-], of all that does not depend on light. prnu: share. mean_dn, variance_dn2: the curve.
    """

    gain_dn_e: float
    gain_sd: float
    read_e: float
    read_sd: float
    prnu: float
    prnu_sd: float
    mean_dn: np.ndarray
    variance_dn2: np.ndarray


def photon_transfer(
    raw: np.ndarray, expected: np.ndarray, bits: int, black_dn: float = 0.0, bins: int = 32, least: int = 50
) -> PhotonTransfer:
    """Fit the photon transfer equation to raw values and what they are expected to be.

    Values are binned by their expectation; a bin's variance is that of raw - expected about its median, without what is farther off
    than three standard deviations: pixels whose expectation is wrong (edges, a model that did not fit) do not count. Bins of which
    the noise reaches the ends of the converter are left out.

    Args:
        raw: (N,) DN. expected: (N,) DN, black level included. bits: of the converter. least: values that a bin must have.
    Raises:
        InputError: too few values, or no range of light.
    """
    white = 2.0**bits - 1.0
    usable = np.isfinite(expected) & (expected > black_dn) & (expected < white)
    raw, expected = raw[usable].astype(np.float64), expected[usable].astype(np.float64)
    bins = min(bins, len(raw) // least)
    if bins < 4:
        raise InputError(f"photon transfer: {len(raw)} usable values, expected at least {4 * least}.")
    # as many values in each: dark ones, which tell the read noise, are many
    edges = np.unique(np.quantile(expected, np.linspace(0, 1, bins + 1)))
    index = np.clip(np.searchsorted(edges, expected, side="right") - 1, 0, len(edges) - 2)
    mean, variance, weight = [], [], []
    for b in range(len(edges) - 1):
        difference, here = (raw - expected)[index == b], expected[index == b]
        if len(here) < least:
            continue
        spread = _variance(difference)
        if here.min() < 3.0 * spread**0.5 or here.max() > white - 3.0 * spread**0.5:
            continue
        mean.append(float(here.mean()) - black_dn)
        variance.append(spread)
        weight.append(len(here) / 2.0)  # the variance of a variance of n normal values is 2 σ⁴ / n
    if len(mean) < 4 or max(mean) < 2.0 * min(mean):
        raise InputError("photon transfer: the values have no range of light, expected bright and dark ones.")
    mu, v, n = np.array(mean), np.array(variance), np.array(weight)
    design = np.stack([np.ones_like(mu), mu, mu**2], 1)
    predicted = v
    for _ in range(10):  # weights are those of the fitted curve
        scale = np.sqrt(n) / np.maximum(predicted, 1e-3)
        solution, _ = nnls(design * scale[:, None], (v - 1.0 / 12.0).clip(min=0.0) * scale)
        predicted = design @ solution + 1.0 / 12.0
    free = solution > 0
    covariance = np.zeros((3, 3))
    covariance[np.ix_(free, free)] = np.linalg.pinv((design * scale[:, None])[:, free].T @ (design * scale[:, None])[:, free])
    constant, gain, square = (float(x) for x in solution)
    if gain <= 0:
        raise InputError("photon transfer: the variance does not grow with light, expected shot noise.")
    read, prnu = np.sqrt(constant) / gain, np.sqrt(square)
    # of a root, by the variance of its square; of a root that is 0, what its square might be
    gradient = np.array([0.5 / (np.sqrt(constant) * gain) if constant > 0 else 0.0, -np.sqrt(constant) / gain**2, 0.0])
    return PhotonTransfer(
        gain_dn_e=gain,
        gain_sd=float(np.sqrt(covariance[1, 1])),
        read_e=float(read),
        read_sd=float(np.sqrt(gradient @ covariance @ gradient)),
        prnu=float(prnu),
        prnu_sd=float(0.5 * np.sqrt(covariance[2, 2]) / prnu) if prnu > 0 else 0.0,
        mean_dn=mu + black_dn,
        variance_dn2=v,
    )


def _variance(values: np.ndarray) -> float:
    """Variance about the median, of what lies within three standard deviations, as if the others were a normal distribution's."""
    low, middle, high = np.quantile(values, (0.1587, 0.5, 0.8413))
    # whole numbers have steps in their quantiles: never less than the spread of rounding
    limit = 3.0 * max(0.5 * (high - low), 12.0**-0.5)
    for _ in range(5):
        within = values[np.abs(values - middle) <= limit] - middle
        variance = float(np.mean(within**2)) / _OF_THREE
        limit = 3.0 * max(variance**0.5, 12.0**-0.5)
    return variance
