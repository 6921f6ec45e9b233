"""How samples become pixels: rays through the surface, sections between samples, and the appearance where they cross it.

All lengths are in the normalised frame, where the region of interest is the unit ball. Where a scene has a background, all of
space is contracted into a ball of radius 2, and the one surface reaches as far as rays do.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.surface import Surface

NEAR = 0.02  # radii from a camera at which rays begin at the least, when all of space is seen
_FREE = 0.8  # of the way from a camera to the region of interest, where rays begin then
HORIZON = 1e3  # where rays end that nothing stops, in radii


@dataclass(frozen=True)
class Sampling:
    """How finely a ray is seen.

    Attributes:
        sharpness: s of the surface; its soft part is about 3.5 / s thick. step: between samples at the surface, in contracted
            space. active_surface, active_radiance: levels of the grids.
        sphere_step_factor: share of the free distance that a ray goes at once, away from the surface.
        min_slope: a ray that approaches the surface at less than this slope steps as if it had it.
        min_section_weight: sections of a smaller weight are given no appearance of their own.
        max_optical_depth: optical depth at which a ray ends.
    """

    sharpness: float
    step: float
    active_surface: int
    active_radiance: int
    sphere_step_factor: float = 0.7
    min_slope: float = 0.5
    min_section_weight: float = 1e-2
    max_optical_depth: float = 3.0


@dataclass(frozen=True)
class Hits:
    """What R rays meet: features (R, F), the mean over the hit; opacity (R,) in [0, 1]; depth (R,), the ray distance at which
    half of the light is met, NaN = no hit; samples: how many were taken, a number."""

    features: Tensor
    opacity: Tensor
    depth: Tensor
    samples: Tensor


def ball_interval(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays are inside the unit ball: near, far (R,); equal (empty) for rays that miss it or leave it behind."""
    middle = -(origins * directions).sum(-1)
    # distance² of the closest approach, from the perpendicular: |o|² - middle² would cancel for far cameras
    perpendicular = origins + middle[:, None] * directions
    half = torch.sqrt((1.0 - (perpendicular * perpendicular).sum(-1)).clamp(min=0.0))
    near = (middle - half).clamp(min=0.0)
    return near, torch.maximum(middle + half, near)


def interval(surface: Surface, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays begin and end: near, far (R,)."""
    if surface.grid.extent > 1.0:
        # a surface right before a camera explains its picture and no other: there is none
        near = (_FREE * (torch.linalg.vector_norm(origins, dim=-1) - 1.0)).clamp(min=NEAR)
        return near, torch.full_like(near, HORIZON)
    return ball_interval(origins, directions)


def trace(
    surface: Surface, appearance: HashGrid, occupancy: Occupancy, origins: Tensor, directions: Tensor, jitter: Tensor, sampling: Sampling
) -> Hits:
    """March, evaluate, weigh and composite the features of rays.

    Appearance is looked up where each section crosses the surface, once per section that matters; it is shaded once per ray.

    Args:
        origins, directions: (R, 3), unit directions; gradients reach them with the samples' distances held fixed.
        jitter: (R,) in [0, 1), shifts the samples.
    """
    near, far = interval(surface, origins.detach(), directions.detach())
    if kernels.on_cpu(origins):
        return Hits(*kernels.cpu.trace(surface, appearance, occupancy.states, origins, directions, near, far, jitter, sampling))
    return trace_by_parts(surface, appearance, occupancy, origins, directions, near, far, jitter, sampling)


def trace_by_parts(
    surface: Surface, appearance: HashGrid, occupancy: Occupancy, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor,
    jitter: Tensor, sampling: Sampling,
) -> Hits:  # fmt: skip
    """``trace`` from single operations, with autograd, on any device and in any precision; near, far: (R,)."""
    with torch.no_grad():
        samples = kernels.march(
            lambda x: surface(x, sampling.active_surface), origins, directions, near, far, jitter, occupancy.states,
            surface.grid.extent, sampling,
        )  # fmt: skip
    return composite(surface, appearance, origins, directions, samples, sampling)


def composite(
    surface: Surface, appearance: HashGrid, origins: Tensor, directions: Tensor, samples: tuple[Tensor, Tensor, Tensor], sampling: Sampling
) -> Hits:
    """Evaluate, weigh and composite samples of R rays; samples: t, ray, offsets, see ``kernels.march``."""
    rays = len(origins)
    t, ray, offsets = samples

    def place(ray: Tensor, t: Tensor) -> Tensor:
        return surface.grid.to_grid(origins[ray] + directions[ray] * t[:, None])

    sdf = surface(place(ray, t), sampling.active_surface)
    weights, crossing = kernels.section_weights(sdf, sampling.sharpness, offsets)
    with torch.no_grad():
        # what is left of a ray that was ended goes to its last section
        before = kernels.exclusive_sum(weights, offsets, ray)
        enough = -torch.expm1(torch.tensor(-sampling.max_optical_depth))
        ends = (before + weights > enough) & ~(before > enough)
        rest = torch.where(ends, 1.0 - before - weights, torch.zeros_like(weights))
    weights = weights + rest
    opacity = weights.new_zeros(rays).index_add(0, ray, weights)
    chosen = torch.nonzero(weights.detach() > sampling.min_section_weight)[:, 0]
    following = (chosen + 1).clamp(max=max(len(t) - 1, 0))
    at, w = ray[chosen], weights[chosen]
    encoded = appearance(place(at, torch.lerp(t[chosen], t[following], crossing[chosen])), sampling.active_radiance)
    shown = w.new_zeros(rays).index_add(0, at, w)
    features = torch.zeros(rays, appearance.width, dtype=w.dtype, device=w.device).index_add(0, at, w[:, None] * encoded)
    depth = median_depth(t, weights.detach(), before, crossing, ray, rays)
    return Hits(features / shown.clamp(min=1e-12)[:, None], opacity, depth, torch.tensor(len(t)))


def median_depth(t: Tensor, weights: Tensor, before: Tensor, crossing: Tensor, ray: Tensor, rays: int) -> Tensor:
    """Ray distance at which half of the light is met, at the surface crossing of that section: (R,), NaN = no hit.

    Args:
        t, weights, before, crossing, ray: (N,) of packed samples; ``before`` is the weight in front of each section.
    """
    depth = torch.full((rays,), float("nan"), dtype=t.dtype, device=t.device)
    reached = torch.nonzero((before + weights >= 0.5) & (before < 0.5))[:, 0]
    following = (reached + 1).clamp(max=max(len(t) - 1, 0))
    return depth.index_put((ray[reached],), torch.lerp(t[reached], t[following], crossing[reached]))
