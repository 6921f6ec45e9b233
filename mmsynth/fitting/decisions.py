"""Two questions that residuals answer during a fit: how far radiance depends on direction, and whether exposures differ between frames.

Rays are compared with what was measured, see ``candidates``: of views that are held out, see ``held_out``, and of the others for exposures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.field import Field
from mmsynth.field.radiance import Shader
from mmsynth.fitting.candidates import Look, errors_of_copies, look_twice
from mmsynth.fitting.choices import Choice, switch
from mmsynth.fitting.measurements import Measurements
from mmsynth.fitting.needs import Needs
from mmsynth.fitting.recipe import RadianceRecipe

_SURE = 2.0  # standard errors


@dataclass(frozen=True)
class Decisions:
    """Degree of the harmonics of each modality's radiance over directions, and whether frames have exposure factors of their own."""

    view_dependence: dict[str, Choice[int]]
    exposure: Choice[bool]

    @property
    def choices(self) -> dict[str, Choice[Any]]:
        return {**{f"view_dependence.{name}": choice for name, choice in self.view_dependence.items()}, "exposure": self.exposure}


def decide(
    field: Field,
    measurements: Measurements,
    selected: tuple[kernels.Selection, kernels.Selection],
    recipe: RadianceRecipe,
    needs: Needs,
    sampling: kernels.Sampling,
    seed: int,
) -> Decisions:
    """Put the residuals of a field as it is to the tests of this module.

    Args:
        selected: the pixels that it has learned from, and those that it has not learned directions from.
    """
    looks = look_twice(field, measurements, selected, sampling, np.random.default_rng((seed, 2)))
    learned = next(looks)
    if recipe.view_dependence == "auto":
        errors = errors_by_degree(field.shader, needs.directions, learned, next(looks))
        degrees = choose_degrees(errors, recipe.view_dependence_min_improvement)
    else:
        degrees = dict.fromkeys(measurements, needs.choices["directions"])
    return Decisions(degrees, _exposure(field, learned, measurements, recipe))


def choose_degrees(errors: dict[str, Tensor], worth: float) -> dict[str, Choice[int]]:
    """Each modality's degree: what its own errors ask for, and what those of all together do.

    Sensors see one scene. By its own errors alone a noisier one now and then falls a little short of what the others clearly need.

    Args:
        errors: by modality, as ``errors_by_degree`` returns them.
    """
    relative = [own / own[-1].mean() for own in errors.values() if own.shape[1] and bool(own[-1].mean() > 0)]
    together = degree_needed(torch.cat(relative, 1), worth) if relative else 0
    return {name: _degree(own, max(degree_needed(own, worth), together)) for name, own in errors.items()}


def _degree(errors: Tensor, degree: int) -> Choice[int]:
    means = errors.mean(1).tolist() if errors.shape[1] else [0.0]
    best = means[-1]
    grown = ", ".join(f"{e / best - 1:+.1%}" for e in means[:-1]) if best > 0 else "nothing that could be told apart"
    others = ", ".join(map(str, range(len(errors) - 1)))
    return Choice(degree, f"degree {degree}: error with degree {others} in place of {len(errors) - 1}: {grown}", degree > 0)


@torch.no_grad()
def _exposure(field: Field, looks: Sequence[Look], measurements: Measurements, recipe: RadianceRecipe) -> Choice[bool]:
    of_looks = [(_predicted(field, seen), seen.batch.measured.target, seen.weight, seen.batch.frame, seen.usable) for seen in looks]
    spreads = {}
    for name, (_, own) in looks[0].batch.parts.items():  # alike in all looks
        m = measurements[name]
        *numbers, usable = (torch.cat([x[own] for x in of_all]).cpu().numpy() for of_all in zip(*of_looks, strict=True))
        predicted, target, weight, frame = (x[usable] for x in numbers)
        spread, noise = exposure_spread(predicted / m.radiance_scale, target / m.radiance_scale, weight, frame)
        spreads[name] = spread if spread > 2 * noise / math.sqrt(len(m.origins)) else 0.0
    why = "exposure differs between frames by " + ", ".join(f"{n} {s:.1%}" for n, s in spreads.items())
    if recipe.exposure != "auto":
        return switch(recipe.exposure == "on", f"asked for by the recipe; {why}")
    return switch(max(spreads.values()) > recipe.exposure_min_spread, why)


def _predicted(field: Field, seen: Look) -> Tensor:
    """(M,) of each number of a look, by the field as it is."""
    batch, hits = seen.batch, seen.hits
    ray = kernels.rays_of(hits.behind, len(hits.share))
    outputs = field.shader(hits.features, batch.directions[ray], batch.per_ray(field.view_dependence)[ray])
    return kernels.predict(outputs, hits.share, batch.measured, hits.behind) + seen.mirrored


def errors_by_degree(shader: Shader, most: int, learned: Sequence[Look], judged: Sequence[Look]) -> dict[str, Tensor]:
    """Squared errors of each modality with directions up to degree 0, 1, ... ``most``, at rays that were not learned from.

    Returns:
        by modality, (most + 1, N); N = 0 where every number is clipped.
    """
    return errors_of_copies(shader, learned, judged, [(degree, True) for degree in range(most + 1)])


def degree_needed(errors: Tensor, worth: float) -> int:
    """The lowest degree whose mean error is within ``worth`` (a share) or two standard errors of the best, from errors (degrees, N) at the
    same N numbers; 0 where there are none."""
    if not errors.shape[1]:
        return 0
    means = errors.mean(1)
    best = int(means.argmin())
    more = errors - errors[best]
    allowed = torch.maximum(worth * means[best], _SURE * more.std(1, correction=0) / errors.shape[1] ** 0.5)
    return next((degree for degree in range(len(errors)) if more[degree].mean() <= allowed[degree]), 0)


def exposure_spread(predicted: np.ndarray, target: np.ndarray, weight: np.ndarray, frame: np.ndarray) -> tuple[float, float]:
    """Standard deviation of log exposure between frames beyond what noise gives, and the error of one frame's, medians.

    Each frame's gain is the least-squares factor between predicted and target.

    Args:
        predicted, target: numbers of one modality that are not clipped, (N,) each, in units of its level. weight: (N,) of each
            in a mean. frame: (N,) index.
    """
    gains, errors = [], []
    for index in np.unique(frame):
        here = frame == index
        p, t, w = (x[here].astype(np.float64) for x in (predicted, target, weight))
        power = float(p @ (w * p))
        if here.sum() < 16 or power <= 0:
            continue
        gain = float(p @ (w * t)) / power
        if gain > 0:
            gains.append(np.log(gain))
            errors.append(np.sqrt(np.square(w * p * (t - gain * p)).sum()) / (power * gain))
    if len(gains) < 2:
        return 0.0, 0.0
    error = float(np.median(errors))
    # a robust spread: a frame in which something else is wrong is not an exposure
    spread = 1.4826 * float(np.median(np.abs(np.array(gains) - np.median(gains))))
    return float(np.sqrt(max(spread**2 - error**2, 0.0))), error
