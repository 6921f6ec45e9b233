"""Normals of neighbouring places outside of the region, pulled together."""

from __future__ import annotations

import numpy as np
import torch
from analytic import RGB

from mmsynth.field import kernels, rendering
from mmsynth.field.design import Design
from mmsynth.field.field import Field
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.smoothness import LEAST, MOST, PAIRS, neighbours, smooth
from mmsynth.scene.scene import Region

OUT = 1.8  # radii in contracted space, of the horizon that rays from within meet
RAYS = 1024


def _field(horizon: float, rough: float) -> Field:
    """A hollow ball seen from within, with bumps."""
    torch.manual_seed(0)
    design = Design(
        surface_levels=3, surface_rows_log2=14, surface_finest=48, coarsest=8, radiance_levels=2, radiance_rows_log2=10,
        radiance_finest=16, background=True, occupancy=24, initial_radius=0.1, outer_radius=horizon,
    )  # fmt: skip
    field = Field(design, {"rgb": RGB}, {"rgb": 0.5}, Region((0.0, 0.0, 0.0), 1.0))
    with torch.no_grad():
        field.surface.output_weight[:-1].uniform_(-rough, rough)
        field.surface.grid.table.uniform_(-1.0, 1.0)
    field.occupancy.update(field.surface.at(3), field.sampling.sharpness)
    return field


def _rays(rays: int = RAYS) -> tuple[torch.Tensor, torch.Tensor]:
    directions = np.random.default_rng(1).normal(size=(rays, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return torch.from_numpy(0.5 * directions).float(), torch.from_numpy(directions).float()


def _pulled(field: Field, origins: torch.Tensor, directions: torch.Tensor, seed: int = 0) -> tuple[float, dict[str, torch.Tensor]]:
    """The loss of a step of which nothing else is asked, and gradients."""
    for parameter in field.parameters():
        parameter.grad = None
    none, index, count, sampling = torch.empty(0), torch.empty(0, dtype=torch.int64), len(origins), field.sampling
    jitter = torch.full((count,), 0.5)
    rays = kernels.Rays(origins, directions, *rendering.interval(field.surface, origins, directions), jitter)
    view = kernels.View(torch.zeros(count, dtype=torch.int64), torch.ones(count, dtype=torch.bool))
    nothing = torch.empty(0, 3)
    pull = smooth(neighbours(PAIRS, torch.Generator().manual_seed(seed)), Recipe())
    found = kernels.learn(kernels.arrange(kernels.Step(
        *field.surface.at(3), field.appearance.at(2), field.occupancy.states, field.shader.weights(), kernels.no_light("cpu"), none, rays,
        view, kernels.Measured(none, index, index, nothing, none, none, none), kernels.Gains(none, index),
        kernels.Opacities(none, none, none, none, 0.05), kernels.Eikonal(nothing, nothing, 0.0, 0.1, 0.1, 1.0), pull, sampling,
    )))  # fmt: skip
    gradients = {name: p.grad.clone() for name, p in field.named_parameters() if p.grad is not None and p.grad.any()}
    return float(found.loss), gradients


@torch.no_grad()
def _roughness(field: Field) -> float:
    """Mean of 1 - n·r over what rays from the centre meet, r away from it: of a smooth ball 0."""
    origins, directions = _rays(2000)
    depth = field.trace(origins, directions, field.sampling).depth
    points = (origins + directions * depth[:, None])[torch.isfinite(depth)]
    slopes = field.surface.gradient(field.surface.grid.to_grid(points), 0.03, 3)
    return float((1.0 + torch.nn.functional.normalize(slopes, dim=-1).mul(torch.nn.functional.normalize(points, dim=-1)).sum(-1)).mean())


def test_bumps_of_a_wall_get_smaller() -> None:
    field = _field(OUT, 0.02)
    before = _roughness(field)
    assert before > 0.01
    for step in range(60):
        _, gradients = _pulled(field, *_rays(), step)
        assert set(gradients) == {"surface.hidden", "surface.output_weight", "surface.grid.table"}
        with torch.no_grad():
            for name, parameter in field.named_parameters():
                if name in gradients:
                    parameter -= 0.01 * gradients[name] / gradients[name].abs().max()
    assert _roughness(field) < 0.5 * before


def test_of_a_smooth_ball_there_is_what_its_curvature_makes() -> None:
    """Places r apart on a ball seen from its centre, ``aside`` of random directions: by the angle between them."""
    field = _field(OUT, 0.0)
    loss, _ = _pulled(field, *_rays())
    aside = neighbours(PAIRS, torch.Generator().manual_seed(0))
    chosen = _rays()[1][torch.arange(PAIRS) * RAYS // PAIRS]
    cosine = torch.nn.functional.cosine_similarity(chosen, chosen + aside, dim=-1)
    expected = Recipe().loss.smooth_weight * ((1.0 - cosine) / (1.0 - cosine + 0.3)).mean()
    assert abs(loss / float(expected) - 1.0) < 0.02


def test_what_is_in_the_region_is_not_asked() -> None:
    field = _field(OUT, 0.02)
    origins, directions = _rays()
    inwards = 3.0 * origins / torch.linalg.vector_norm(origins, dim=-1, keepdim=True)  # the small ball in the middle
    assert _pulled(field, inwards, -directions) == (0.0, {})


def test_neighbours_are_as_far_as_they_may_be() -> None:
    length = torch.linalg.vector_norm(neighbours(5000, torch.Generator().manual_seed(0)), dim=-1)
    assert LEAST <= float(length.min()) < 1.1 * LEAST and 0.99 * MOST < float(length.max()) <= 1.0001 * MOST
