"""What a sensor adds to light: noise, fixed pattern, saturation, quantisation, in the terms of EMVA 1288 (release 4).

Light is linear, 1.0 = full scale, (..., H, W) at the photosites. It becomes electrons, μ_e = light · (2^bits - 1 - black) / K, then
numbers: y = K (electrons) + black, rounded and clipped. The variance of y follows the photon transfer equation

    σ_y² = K² σ_d² + 1 / 12 + K (μ_y - black) + PRNU² (μ_y - black)²

Randomness is keyed by (seed, sensor, frame, effect): a frame does not depend on which others are made, in what order or batch, and the
fixed pattern belongs to the sensor and not to the frame. It is drawn on the CPU, so that every device records the same.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch
from pydantic import ConfigDict, with_config
from torch import Tensor

from mmsynth.errors import InputError


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True)
class NoiseModel:
    """A sensor's figures, names and units of EMVA 1288.

    Attributes:
        bits: of the converter. black_dn: black level [DN]. gain_dn_e: system gain K [DN / e-]. full_well_e: saturation capacity [e-].
        read_e: temporal dark noise σ_d [e-]. dark_e_s: dark current [e- / s], during exposure_s [s].
        row_e: noise that a row has in common [e-]. dsnu_e: spread of the dark signal between pixels [e-]. prnu: spread of their
            response, as a share of 1.
        crosstalk: share of a pixel's electrons that is counted in each of its four neighbours (interpixel capacitance: the shot noise of
            neighbours is correlated).
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
    crosstalk: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 16:
            raise InputError(f"noise: bits is {self.bits}, expected 1 to 16.")
        for name, value in asdict(self).items():
            positive = name in ("gain_dn_e", "full_well_e")
            if not (0 < value < float("inf") or (value == 0 and not positive)):
                raise InputError(f"noise: {name} is {value}, expected a {'positive number' if positive else 'number of at least 0'}.")
        if self.crosstalk > 0.2:
            raise InputError(f"noise: crosstalk is {self.crosstalk}, expected at most 0.2: a pixel keeps as much as each neighbour gets.")
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
    collected = electrons + noise
    if model.crosstalk:
        collected = _share_with_neighbours(collected, model.crosstalk)
    if model.read_e:
        collected = collected + model.read_e * torch.stack([normal("read", frame) for frame in frames])
    if model.row_e:
        collected = collected + model.row_e * torch.stack([normal("row", frame, (shape[0], 1)) for frame in frames])
    held = collected.clamp(max=model.full_well_e)
    numbers = (held * model.gain_dn_e + model.black_dn).clamp(0.0, model.white_dn)
    return numbers + (torch.round(numbers) - numbers).detach()


def _share_with_neighbours(electrons: Tensor, share: float) -> Tensor:
    """(B, H, W): each of the four neighbours gets a share; what would leave the frame stays."""
    from kornia.filters import filter2d  # a second to import

    kernel = electrons.new_tensor([[0.0, share, 0.0], [share, 1.0 - 4.0 * share, share], [0.0, share, 0.0]])
    return filter2d(electrons[:, None], kernel[None], border_type="replicate")[:, 0]
