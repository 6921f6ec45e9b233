"""What the shader would reach if it were another: copies learn on for some steps, geometry and appearance held fixed, and are compared at
rays that none of them has learned from.

A copy that can do without something has learned to by then. (Asking only what the shader loses when something is taken from it would not
tell: it uses what it is given, needed or not.) Copies learn from many rays, some in each step: from few they learn those by heart, most of
all where they see directions. Many rays judge, too: errors have long tails.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.field import Field
from mmsynth.field.radiance import Shader
from mmsynth.fitting.measurements import Batch, Measurements, draw
from mmsynth.fitting.optimiser import Adam
from mmsynth.parallel import tile_by_tile

_LOOKS, _RAYS = 8, 2048  # that judge, of so many rays of a modality each, and as many, half as large, that copies learn from in turn
_STEPS = 40
_RATE = 4e-3


@dataclass(frozen=True)
class Look:
    """Rays of all modalities, the surfaces that they met, and the light (M,) in each number that is mirrored and not the shader's."""

    batch: Batch
    hits: kernels.Hits
    mirrored: Tensor

    @property
    def usable(self) -> Tensor:
        """(M,) which numbers can be judged: clipped ones cannot."""
        return self.batch.measured.target < self.batch.measured.saturation

    @property
    def weight(self) -> Tensor:
        """(M,) of each number's ray, as it was drawn more or less often than evenly."""
        return self.batch.ray_weight[self.batch.measured.ray]


def look(field: Field, measurements: Measurements, rays: int, sampling: kernels.Sampling, random: np.random.Generator) -> Look:
    """So many rays of each modality, as the field renders them, of all pixels that are learned from alike."""
    return _seen(field, draw(measurements, field.shader.columns, dict.fromkeys(measurements, rays), random), sampling)


@torch.no_grad()
def _seen(field: Field, batch: Batch, sampling: kernels.Sampling) -> Look:
    hits = field.trace(batch.origins, batch.directions, sampling)
    return Look(batch, hits, field.mirrored(hits, batch.origins, batch.directions, batch.measured, sampling.active_surface))


def look_twice(
    field: Field,
    measurements: Measurements,
    selected: tuple[kernels.Selection, kernels.Selection],
    sampling: kernels.Sampling,
    random: np.random.Generator,
) -> Iterator[list[Look]]:
    """What copies learn from, and then, if it is asked for, what judges them; ``selected``: of which pixels, each."""
    for rays, selection in zip((_RAYS // 2, _RAYS), selected, strict=True):
        of_look = measurements, field.shader.columns, dict.fromkeys(measurements, rays), random, selection
        batches = (draw(*of_look) for _ in range(_LOOKS))
        yield [seen for _, seen in tile_by_tile(field.device, lambda batch: _seen(field, batch, sampling), batches)]


def errors_of_copies(
    shader: Shader, learned: Sequence[Look], judged: Sequence[Look], copies: Iterable[tuple[int, bool]]
) -> dict[str, Tensor]:
    """Squared errors of copies of the shader that have learned on, side by side, by modality; they count as their rays weigh.

    Args:
        copies: degree of the harmonics of the direction that each sees, and whether mirrored light is added to its own.
    Returns:
        (copies, N) at the numbers that can be judged; N = 0 where every number is clipped.
    """
    work = lambda of_copy: squared_errors(shader, learned, judged, *of_copy)
    squared = [errors for _, errors in tile_by_tile(judged[0].batch.origins.device, work, copies)]
    out: dict[str, list[Tensor]] = {name: [] for name in judged[0].batch.parts}
    for seen, *of_look in zip(judged, *squared, strict=True):
        errors, usable = torch.stack(of_look) * seen.weight, seen.usable
        for name, (_, numbers) in seen.batch.parts.items():
            out[name].append(errors[:, numbers][:, usable[numbers]])
    return {name: torch.cat(parts, 1) for name, parts in out.items()}


def squared_errors(shader: Shader, learned: Sequence[Look], judged: Sequence[Look], degree: int, mirrors: bool) -> list[Tensor]:
    """Those of the numbers of each look, (M,), by one copy that has learned on from other looks; see ``errors_of_copies``."""
    candidate = copy.deepcopy(shader)
    parameters = dict(candidate.named_parameters())
    optimiser = Adam(parameters, dict.fromkeys(parameters, _RATE))
    for step in range(_STEPS):
        loss, _ = _compare(candidate, learned[step % len(learned)], degree, mirrors)
        loss.backward()
        optimiser.step(1.0 - step / _STEPS)
    with torch.no_grad():
        return [_compare(candidate, seen, degree, mirrors)[1] for seen in judged]


def _compare(shader: Shader, seen: Look, degree: int, mirrors: bool) -> tuple[Tensor, Tensor]:
    hits, batch = seen.hits, seen.batch
    degrees = torch.full((len(batch.origins),), degree, device=batch.origins.device)
    rays = kernels.ShadedRays(hits.features, hits.share, hits.behind, batch.directions, degrees, degrees >= 0)
    return kernels.compare(shader.weights(), rays, batch.measured, None, seen.mirrored / batch.measured.level if mirrors else None)
