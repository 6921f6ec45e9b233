"""How samples become pixels: rays through the region of interest, sections, features, and what is behind.

All lengths are in the normalised frame, where the region of interest is the unit ball.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.background import Background
from mmsynth.field.encoding import HashGrid
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.surface import Surface

_SIGNIFICANT = 1e-3  # sections below this weight are not given a colour: at most 4 % of a ray of 40 sections, usually none


@dataclass(frozen=True)
class Sampling:
    """How finely a ray is seen: sharpness s of the surface, step between samples, active grid levels.

    ``view_dependence`` scales what the shader sees of the direction: 0 = radiance is the same in all directions.
    """

    sharpness: float
    step: float
    active_surface: int
    active_radiance: int
    active_background: int
    background_samples: int = 16
    view_dependence: float = 1.0


@dataclass(frozen=True)
class Hits:
    """What the rays meet, R rays: features (R, F) (their mean over the hit), opacity (R,), and all samples taken."""

    features: Tensor
    opacity: Tensor
    positions: Tensor
    t: Tensor
    ray: Tensor
    offsets: Tensor
    weights: Tensor
    crossing: Tensor


def ball_interval(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays are inside the unit ball: near, far (R,); equal (empty) for rays that miss it or leave it behind."""
    middle = -(origins * directions).sum(-1)
    # distance² of the closest approach, from the perpendicular: |o|² - middle² would cancel for far cameras
    perpendicular = origins + middle[:, None] * directions
    half = torch.sqrt((1.0 - (perpendicular * perpendicular).sum(-1)).clamp(min=0.0))
    near = (middle - half).clamp(min=0.0)
    return near, torch.maximum(middle + half, near)


def trace(
    surface: Surface, appearance: HashGrid, occupancy: Occupancy, origins: Tensor, directions: Tensor, jitter: Tensor, sampling: Sampling
) -> Hits:
    """March, evaluate, weigh and composite the features of the region of interest.

    Appearance is looked up where each section crosses the surface, once per section that matters, and shaded once per ray.

    Args:
        origins, directions: (R, 3), unit directions. jitter: (R,) in [0, 1).
    """
    rays = origins.shape[0]
    near, far = ball_interval(origins, directions)
    t, ray, offsets = kernels.march(origins, directions, near, far, jitter, occupancy.states, sampling.step)
    positions = origins[ray] + directions[ray] * t[:, None]
    sdf = surface(positions, sampling.active_surface)
    weights, crossing = kernels.section_weights(sdf, sampling.sharpness, offsets)
    chosen = torch.nonzero(weights.detach() > _SIGNIFICANT)[:, 0]
    at = ray[chosen]
    t_hit = torch.lerp(t[chosen], t[(chosen + 1).clamp(max=max(len(t) - 1, 0))], crossing[chosen])
    encoded = appearance(origins[at] + directions[at] * t_hit[:, None], sampling.active_radiance)
    total = kernels.accumulate(weights[chosen], torch.cat([encoded, torch.ones_like(encoded[:, :1])], 1), at, rays)
    opacity = total[:, -1]
    features = total[:, :-1] / opacity.clamp(min=_SIGNIFICANT)[:, None]
    return Hits(features, opacity, positions, t, ray, offsets, weights, crossing)


def background_hidden(background: Background, origins: Tensor, directions: Tensor, jitter: Tensor, sampling: Sampling) -> Tensor:
    """Hidden layer of the background's shader, (R, H), for rays that see past the region of interest."""
    near, far = ball_interval(origins, directions)
    distance = torch.linalg.vector_norm(origins, dim=-1)
    # rays that miss the ball see everything from half-way to it on
    start = torch.where(far > near, far, 0.5 * distance).clamp(min=1e-2)
    features = background(origins, directions, start, jitter, sampling.background_samples, sampling.active_background)
    return background.shader.hidden(features, directions, sampling.view_dependence)


def median_depth(hits: Hits, rays: int) -> Tensor:
    """Ray distance at which half of the light is met, at the surface crossing of that section: (R,), NaN = no hit."""
    depth = torch.full((rays,), float("nan"), device=hits.t.device)
    if not len(hits.t):
        return depth
    before = hits.weights.cumsum(0) - hits.weights
    passed = before - before[hits.offsets[:-1].clamp(max=len(hits.t) - 1)][hits.ray] + hits.weights
    reached = torch.nonzero((passed >= 0.5) & (passed - hits.weights < 0.5))[:, 0]
    following = (reached + 1).clamp(max=len(hits.t) - 1)
    depth[hits.ray[reached]] = torch.lerp(hits.t[reached], hits.t[following], hits.crossing[reached])
    return depth
