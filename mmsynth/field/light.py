"""Lamps, and how rough and how strong surfaces mirror them: the part of radiance that moves with the viewer.

What a sensor sees of a surface is a diffuse part, which the shader paints, and the images of the lamps, blurred by the surface's
roughness (see ``kernels.mirroring`` for the model). Normals are gradients of the distance, so that highlights, and their polarization,
shape the surface.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from mmsynth.field.kernels import Lamps, LightNetwork, Reflection, Surroundings

LAMPS = 6  # at the most
_HIDDEN = 32
_CHUNK = 64  # surfaces
# roughness, strength, surroundings, transmitted, polarizing before their functions: 0.28, 0.13, 0.05, 0.02, 0.88
_START = (-1.0, -2.0, -3.0, -4.0, 2.0)
_VISIBLE = 2.0  # before its function: 0.88


class Light(nn.Module):
    """Lamps, and what a surface does with them, from its features.

    Args:
        features: of a surface. outputs: of the shader, each with the lamps' light in it (the first of six of a polarization).
    Attributes:
        position: (LAMPS, 3), normalised frame. log_spectrum: (LAMPS, outputs), relative to each modality's typical value.
        used: (LAMPS,) bool, which of them there are.
    """

    used: Tensor

    def __init__(self, features: int, outputs: int) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(features, _HIDDEN), nn.Linear(_HIDDEN, len(_START) + LAMPS)
        with torch.no_grad():
            self.second.bias.copy_(torch.tensor([*_START, *[_VISIBLE] * LAMPS]))
        self.position = nn.Parameter(torch.zeros(LAMPS, 3))
        self.log_spectrum = nn.Parameter(torch.zeros(LAMPS, outputs))
        self.register_buffer("used", torch.zeros(LAMPS, dtype=torch.bool))

    @property
    def count(self) -> int:
        """How many lamps there are, K."""
        return int(np.count_nonzero(self._used))

    @property
    def _used(self) -> np.ndarray:
        """As an array: NumPy is quicker with so few, and a step of a fit asks."""
        return self.used.numpy(force=True)

    def add(self, positions: Tensor) -> None:
        """Lamps as bright as the scene, seen from all surfaces, at (K, 3), in the first K free places."""
        free = torch.nonzero(~self.used)[: len(positions), 0]
        with torch.no_grad():
            self.position[free], self.log_spectrum[free] = positions, 0.0
            self.second.weight[len(_START) + free], self.second.bias[len(_START) + free] = 0.0, _VISIBLE
            self.used[free] = True

    def material(self, features: Tensor) -> Tensor:
        """What surfaces do with the lamps, (H, F) → (H, 5 + K): see ``kernels.mirroring.material``."""
        rows = len(features)
        # products of a fixed size: sums do not depend on the number of threads
        chunks = nn.functional.pad(features, (0, 0, 0, -rows % _CHUNK)).view(-1, _CHUNK, features.shape[1])
        hidden = torch.relu(_layer(chunks, self.first))
        return _layer(hidden, self.second).reshape(-1, self.second.out_features)[:rows, self._columns()]

    def _columns(self) -> Tensor:
        """Of the last layer: all but the visibility of lamps that there are not."""
        return torch.cat([torch.arange(len(_START), device=self.used.device), len(_START) + torch.nonzero(self.used)[:, 0]])

    def network(self) -> LightNetwork:
        """What a step of a fit takes."""
        weights = self.first.weight, self.first.bias, self.second.weight, self.second.bias
        used = torch.from_numpy(np.flatnonzero(self._used)).to(self.used.device)
        return LightNetwork(*weights, self.position, self.log_spectrum, used)

    def lamps(self) -> Lamps:
        """What the kernels take."""
        return Lamps(self.position[self.used], torch.exp(self.log_spectrum[self.used]))


def _layer(chunks: Tensor, layer: nn.Linear) -> Tensor:
    return torch.baddbmm(layer.bias[None, None], chunks, layer.weight.T.expand(len(chunks), -1, -1))


def mean_spectrum(spectrum: Tensor) -> Tensor:
    """(outputs,) geometric mean over lamps of their spectra (K, outputs) > 0."""
    return torch.exp(torch.log(spectrum).mean(0))


def stokes(reflection: Reflection, spectrum: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Stokes vectors (H, 3) of the images of lamps of ``spectrum`` (K,), in the frame of axes x, y (H, 3)."""
    light = reflection.amount * spectrum
    on_x, on_y = ((reflection.axis * axis[:, None]).sum(-1) for axis in (x, y))
    polarized = light * reflection.degree
    parts = light, polarized * (on_x.square() - on_y.square()), polarized * 2.0 * on_x * on_y
    return torch.stack([part.sum(1) for part in parts], -1)


def stokes_around(around: Surroundings, x: Tensor, y: Tensor) -> Tensor:
    """Stokes vectors (H, 3) of light from all around, in the frame of axes x, y (H, 3)."""
    on_x, on_y = ((around.axis * axis).sum(-1) for axis in (x, y))
    return torch.stack([around.light, around.polarized * (on_x.square() - on_y.square()), around.polarized * 2.0 * on_x * on_y], -1)


_DIRECTIONS = 1500  # about 5 degrees apart
_VOTERS = 256  # rays at a time
_CONCENTRATION = 40.0  # of a ray's vote: 9 degrees wide
_APART = math.cos(math.radians(30.0))
_LEAST_VOTE = 0.3  # of the best direction's
_PRIOR = 0.25  # votes without light that every direction has beside its own, of the most that any has


def find_lamps(reflected: Tensor, light: Tensor, missing: Tensor | None = None, known: Tensor | None = None) -> Tensor:
    """Directions (K, 3) of lamps: where mirrored rays that are brighter than their surface go.

    Args:
        reflected: (N, 3) directions of rays after the mirror. light: (N,) ≥ 0, what they saw beyond the surface's own.
        missing: (N,) ≥ 0, what of it is not yet explained, by lamps in the directions ``known`` (L, 3), unit: others are looked for in it,
            and must be as bright beside the brightest of all ``light`` as without it.
    """
    missing, known = light if missing is None else missing, reflected[:0] if known is None else known
    if not bool((missing > 0).any()):
        return reflected[:0]
    i = torch.arange(_DIRECTIONS, dtype=torch.float32, device=light.device) + 0.5
    z = 1.0 - 2.0 * i / _DIRECTIONS
    turn, radius = math.pi * (1.0 + math.sqrt(5.0)) * i, torch.sqrt(1.0 - z * z)
    sphere = torch.stack([radius * torch.cos(turn), radius * torch.sin(turn), z], -1)  # Fibonacci's
    bright, rays = z.new_zeros(2, _DIRECTIONS), torch.zeros_like(z)
    for part, weight in zip(reflected.split(_VOTERS), torch.stack([light, missing], 1).split(_VOTERS), strict=True):
        votes = torch.exp(_CONCENTRATION * (part @ sphere.T - 1.0))
        bright, rays = bright + weight.T @ votes, rays + votes.sum(0)
    whole, score = bright / (rays + _PRIOR * rays.max())
    least = _LEAST_VOTE * whole.max()
    near = (sphere @ known.T > _APART).any(1)
    found: list[Tensor] = []
    while True:
        score = score.masked_fill(near, 0.0)
        if len(known) + len(found) == LAMPS or not bool(score.max() > least):
            return torch.stack(found) if found else reflected[:0]
        found.append(sphere[score.argmax()])
        near = sphere @ found[-1] > _APART
