"""Normals of neighbouring rays outside of the region, pulled together."""

from __future__ import annotations

import numpy as np
import torch
from analytic import RGB

from mmsynth.field.design import Design
from mmsynth.field.field import Field
from mmsynth.fitting.smoothness import pull_together
from mmsynth.scene.scene import Region

OUT = 1.8  # radii in contracted space, of the horizon that rays from within meet


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


def _rays(rays: int = 200) -> tuple[torch.Tensor, torch.Tensor]:
    directions = np.random.default_rng(1).normal(size=(rays, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return torch.from_numpy(0.5 * directions).float(), torch.from_numpy(directions).float()


def _pulled(field: Field, seed: int = 0) -> dict[str, torch.Tensor]:
    for parameter in field.parameters():
        parameter.grad = None
    pull_together(field, *_rays(), field.sampling, 1.0, (seed,))
    return {name: parameter.grad.clone() for name, parameter in field.named_parameters() if parameter.grad is not None}


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
        gradients = _pulled(field, step)
        assert set(gradients) == {"surface.hidden", "surface.output_weight", "surface.grid.table"}
        with torch.no_grad():
            for name, parameter in field.named_parameters():
                if name in gradients:
                    parameter -= 0.01 * gradients[name] / gradients[name].abs().max()
    assert _roughness(field) < 0.5 * before


def test_a_step_has_one_pull() -> None:
    field = _field(OUT, 0.02)
    one, again, other = _pulled(field, 1), _pulled(field, 1), _pulled(field, 2)
    assert all(torch.equal(one[name], again[name]) for name in one)
    assert not torch.equal(one["surface.hidden"], other["surface.hidden"])


def test_what_is_in_the_region_is_not_asked() -> None:
    field = _field(OUT, 0.02)
    origins, directions = _rays()
    inwards = 3.0 * origins / torch.linalg.vector_norm(origins, dim=-1, keepdim=True)  # the small ball in the middle
    for parameter in field.parameters():
        parameter.grad = None
    pull_together(field, inwards, -directions, field.sampling, 1.0, (0,))
    assert all(parameter.grad is None for parameter in field.parameters())
