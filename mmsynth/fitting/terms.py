"""What is asked of opacity and of the distance's slope in a step, beside what was measured."""

from __future__ import annotations

import math

import torch

from mmsynth.field import kernels
from mmsynth.field.field import MIRROR_CELLS, Field
from mmsynth.field.kernels.constants import BLACK
from mmsynth.fitting.measurements import Batch
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.schedule import blocked_weight, is_early, shallow_factor


def opacities(batch: Batch, outside: int, has_opacity: bool, black_background: bool, recipe: Recipe, progress: float) -> kernels.Opacities:
    """What is known of the opacity of a batch's rays, and that so many rays behind them (``outside``) meet nothing.

    Args:
        has_opacity: alpha or masks of an object say it. black_background: else, black pixels say that nothing is there.
    """
    loss, rays, none = recipe.loss, len(batch.origins), batch.ray_weight.new_zeros
    if not (has_opacity or black_background):
        nothing = none(0)
        return kernels.Opacities(nothing, nothing, nothing, nothing, 0.0)
    target, weight, linear, blocked = (none(rays + outside) for _ in range(4))
    weight[rays:] = loss.alpha_weight / max(outside, 1)
    solid = blocked_weight(is_early(progress, recipe), recipe)
    blocked[rays:] = solid / max(outside, 1)
    if has_opacity:
        known = torch.isfinite(batch.alpha)
        target[:rays] = torch.where(known, batch.alpha, target[:rays])
        weight[:rays] = loss.alpha_weight / rays * batch.ray_weight * known
        blocked[:rays] = solid / rays * batch.ray_weight * (batch.alpha == 0.0)
    else:
        m = batch.measured
        black = none(rays).scatter_reduce(0, m.ray, m.target / m.level, "amax") < BLACK
        linear[:rays] = loss.background_opacity_weight / rays * batch.ray_weight * black
    return kernels.Opacities(target, weight, linear, blocked, math.exp(-recipe.sampling.max_optical_depth))


def eikonal_points(recipe: Recipe, shines: bool) -> tuple[int, int]:
    """How many points a step asks in all space, and how many near what rays meet, which is asked everywhere if it shines."""
    count = recipe.loss.eikonal_points if recipe.loss.eikonal_weight > 0 else 0
    return count // 4, 0 if shines else count - count // 4


def eikonal(
    field: Field, sampling: kernels.Sampling, recipe: Recipe, progress: float, points: torch.Tensor, noise: torch.Tensor
) -> kernels.Eikonal:
    """Where the distance is pulled towards a true one: in all space (``points``, a quarter of all), and within the soft surface (by
    ``noise``, standard normal), or at all surfaces that rays meet where these shine, whose normals are known."""
    grid = field.surface.grid
    _, near = eikonal_points(recipe, field.shines)
    noise = noise[:near] * (3.0 / sampling.sharpness)
    cell = grid.cell(sampling.active_surface)
    shallow = shallow_factor(is_early(progress, recipe), recipe)
    return kernels.Eikonal(points.to(field.device), noise.to(field.device), recipe.loss.eikonal_weight, cell, MIRROR_CELLS * cell, shallow)
