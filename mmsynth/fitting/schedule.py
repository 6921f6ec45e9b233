"""What changes while a fit runs, as functions of its progress in [0, 1]."""

from __future__ import annotations

import math
from typing import NamedTuple

from mmsynth.field.kernels import Sampling
from mmsynth.fitting.needs import Needs
from mmsynth.fitting.optimiser import BETAS
from mmsynth.fitting.recipe import Recipe

_LONG_MEMORY = 0.999  # β₂ of a thousand steps


def sampling_at(progress: float, recipe: Recipe, needs: Needs) -> Sampling:
    """Sharpness grows exponentially to its end, the step follows it, and grid levels open one by one."""
    grown = min(1.0, progress / needs.sharpness_until)
    sharpness = recipe.schedule.sharpness_start * (needs.sharpness_end / recipe.schedule.sharpness_start) ** grown
    opened = min(1.0, progress / recipe.schedule.levels_until)

    def active(levels: int) -> int:
        first = min(2, levels)
        return first + round(opened * (levels - first))

    design = needs.design
    return Sampling(
        sharpness=sharpness,
        # at the default, two steps across the soft surface (its width is about 3.5 / s); never coarser than a tenth of the radius
        step=min(0.1, recipe.sampling.step_width / sharpness),
        sphere_step_factor=recipe.sampling.sphere_step_factor,
        min_slope=recipe.sampling.min_slope,
        max_optical_depth=recipe.sampling.max_optical_depth,
        min_section_weight=recipe.sampling.min_section_weight,
        active_surface=active(design.surface_levels),
        active_radiance=active(design.radiance_levels),
    )


def samples_of_step(progress: float, recipe: Recipe) -> float:
    """How many surface samples a step should take.

    They grow exponentially over a fit: a larger batch does for noise what a smaller rate does (Smith et al. 2018), and sees more rays.
    """
    return recipe.sampling.samples_per_step * recipe.sampling.samples_growth ** (progress - 0.5)


class SurfaceRates(NamedTuple):
    """Factors of the learning rates of the surface's network and of its table."""

    network: float
    table: float


def surface_rates(sharpness: float, recipe: Recipe) -> SurfaceRates:
    """Beyond some sharpness the surface's rates fall in proportion to the width of the soft surface.

    A step of Adam moves the surface by about its rate, whatever the gradient. Where that is a good part of the soft surface,
    the surface never settles: colours blur and views disagree. The network moves all of the surface at once, which goes to and fro
    for hundreds of steps where it is fast; rows of the table move a cell each, and those that few rays agree on less (``surface_epsilon``).
    """
    rates = recipe.schedule
    return SurfaceRates(min(1.0, rates.full_rate_sharpness / sharpness), min(1.0, rates.full_rate_sharpness_table / sharpness))


def surface_beta2(progress: float, needs: Needs) -> float:
    """Adam's β₂ of the surface's network: how long it remembers how large gradients were.

    Once the surface is as sharp as it gets, some networks go to and fro for good: for about as many steps as are remembered gradients are
    small, so steps get larger, until one is too large and the shader follows the surface to where it went. A long memory ends it. Sooner
    it would slow down the search for a shape, in which gradients become smaller by themselves.
    """
    return _LONG_MEMORY if progress >= needs.sharpness_until else BETAS[1]


def learning_rate_factor(progress: float, recipe: Recipe) -> float:
    """A short linear rise, then level, then exponential decay over the last two thirds."""
    rise = min(1.0, progress / 0.01)
    fall = max(0.0, (progress - 0.33) / 0.67)
    return max(rise, 0.02) * math.exp(math.log(recipe.schedule.learning_rate_end_factor) * fall)


def is_early(progress: float, recipe: Recipe) -> bool:
    """Whether levels are still to open."""
    return progress < recipe.schedule.levels_until


def blocked_weight(early: bool, recipe: Recipe) -> float:
    """None until all levels are active: till then soft surfaces block rays that pass by, and what is pulled away there is the object."""
    return 0.0 if early else recipe.loss.blocked_weight


def shallow_factor(early: bool, recipe: Recipe) -> float:
    """Of slopes below 1, in the region alone: behind it are no gaps that the grid could resolve, and much that the pull holds together."""
    return recipe.loss.eikonal_shallow_early if early else 1.0


_LOOKS = 3  # before it is decided whether lamps are needed


def light_looks(progress: float, recipe: Recipe) -> int:
    """How often lamps should have been looked for by now: evenly over the time in which they are tried."""
    begin, end = recipe.schedule.light_at, recipe.schedule.light_until
    return 0 if progress < begin else min(_LOOKS, 1 + int(_LOOKS * (progress - begin) / max(end - begin, 1e-9)))
