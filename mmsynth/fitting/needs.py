"""What this scene needs: sizes and parts decided from the cameras and pixels, one function for each question, each with its reason.

Model only what a scene needs: no background where nothing but black lies behind the region of interest, no tensor head
without a polarization sensor (heads follow the sensors), no grid level finer than a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mmsynth.field.design import Design
from mmsynth.fitting.choices import Choice, switch
from mmsynth.fitting.measurements import Measurements, draw
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.table_sizes import rows_log2
from mmsynth.scene.scene import MaskMeaning, Scene
from mmsynth.sensors.camera import Camera

_FACES = 6  # of a cube: the cells that a surface may occupy, in units of the resolution squared
DEGREES = 3  # of spherical harmonics
_FEW = 12  # training views: with 13 as much is won as lost by what is done for few
_OUTERMOST = 2.0  # distance of the farthest camera, at which the sphere around everything stands at the start
_COARSE = 128  # cells across the grid that a surface may have however few the measurements: small pictures show large things
_LOOKED_AT = 4096  # pixels of a modality, to see what is outside
_PAST = 0.005  # share of the pixels that see past the region, below which nothing is there
_RAYS_PER_SECOND = 70_000  # of a fit, about: a constant, so that the design does not depend on the clock
_SAMPLES_PER_RAY = 10  # of a fit, about
SAMPLES_ON_GPU = 1 << 18  # of a step, at the least: with fewer a GPU idles between kernels
_SAMPLES_PER_SECOND_ON_GPU = 100_000_000  # what is asked of one; an H100 takes 125 to 160 million
_BY_RECIPE = "asked for by the recipe"
_NOTHING = "the input says that it is black, transparent or outside the object's masks"


@dataclass(frozen=True)
class Needs:
    """What was chosen and why.

    Attributes:
        footprint: the finest detail to expect at the region's centre, in radii. sharpness_end: of the surface [1/region radius].
        sharpness_until: progress at which it is as sharp.
        black_background: whether black pixels say that nothing is there.
        sparse: modalities that learn their colours from the geometry and appearance of the others: with so few pixels that they would
            spoil what others know better, or without the masks of the object that others have.
        few: whether it is the number of training views that limits a fit, and not that of its steps.
        directions: the highest degree of the harmonics of direction that may be chosen.
        smooth: whether normals of neighbouring places are pulled together, outside of the region.
        share: of the rays that each modality gets, relative to a plentiful one.
        choices: by name; what is decided later is in ``Trainer.choices``.
    """

    design: Design
    footprint: float
    sharpness_end: float
    sharpness_until: float
    black_background: bool
    sparse: tuple[str, ...]
    few: bool
    directions: int
    smooth: bool
    share: dict[str, float]
    choices: dict[str, Choice[Any]]


@dataclass(frozen=True)
class Resolution:
    """Finest cells across the region of the two grids, and the share of a pixel's sharpness that the surface can have."""

    surface: int
    radiance: int
    sharpness: float


@dataclass(frozen=True)
class _Facts:
    """What the questions are answered from: of ``sampled`` pixels the share whose ray misses the region (``outside``), of these the share
    that is bright and the mean light, relative to bright pixels; lengths in radii."""

    scene: Scene
    measurements: Measurements
    recipe: Recipe
    rays_to_come: float
    pixels: int
    footprint: float
    outside: float
    bright: float
    light: float
    sampled: int

    @property
    def coarser(self) -> float:
        """When fewer rays come than there are pixels, what can be learned is coarser than a pixel, by the root of the ratio."""
        return max(1.0, math.sqrt(self.pixels / self.rays_to_come))

    @property
    def views(self) -> int:
        """That train."""
        seen = [f for f in self.scene.frames if f.sensor in self.measurements and f.view in self.scene.split.train]
        return len({frame.view for frame in seen})

    @property
    def few(self) -> bool:
        return self.views <= _FEW

    @property
    def transparent(self) -> bool:
        return self.scene.black_background or any(m.has_opacity for m in self.measurements.values())

    @property
    def unmasked(self) -> list[str]:
        """Modalities without masks of the object that others have: what is behind it is in their pixels."""
        asked = self.scene.masks == "object" and any(m.masked for m in self.measurements.values())
        return [n for n, m in self.measurements.items() if asked and not m.masked]


def expected_rays(recipe: Recipe, steps: int | None, budget: float | None, on_gpu: bool = False) -> float:
    """Rays that a fit of so many steps or seconds will see, about. ``on_gpu``: its steps are those of ``device_step``."""
    if steps is None:
        return (budget or 0.0) * (_SAMPLES_PER_SECOND_ON_GPU / _SAMPLES_PER_RAY if on_gpu else _RAYS_PER_SECOND)
    samples = recipe.sampling.samples_per_step
    return steps * (max(samples, SAMPLES_ON_GPU) if on_gpu else samples) / _SAMPLES_PER_RAY


def assess(scene: Scene, measurements: Measurements, recipe: Recipe, seed: int, rays_to_come: float) -> Needs:
    """Look at the cameras and at some random pixels of each modality.

    Args:
        rays_to_come: about how many rays the fit will see (``expected_rays``).
    """
    pixels = sum(m.pixels for m in measurements.values())
    seen = _look_outside(measurements, np.random.default_rng((seed, 7)))
    facts = _Facts(scene, measurements, recipe, rays_to_come, pixels, footprint_of(measurements), *seen)
    background = _background(facts)
    far_light = _far_light(facts, background.value)
    resolution = _resolution(facts, background.value)
    spheres = _initial_spheres(facts, background.value)
    share = _ray_shares(facts)
    rows = _table_rows(facts)
    directions = _directions(facts)
    smooth = _smooth(facts, background.value)
    choices: dict[str, Choice[Any]] = {
        "masks": _masks(facts),
        "background": background,
        "far_light": far_light,
        "resolution": resolution,
        "initial_sphere": spheres,
        "sparse": share,
        "directions": directions,
        "smooth": smooth,
        "tensor_head": _tensor_head(facts),
    }
    if recipe.schedule.tables_at == 0:  # else the last word on them is said when the cells at the surface are counted
        choices["tables"] = Choice(rows, f"2^{rows[0]} and 2^{rows[1]} rows a level: {_BY_RECIPE}", True)
    design = Design(
        surface_levels=recipe.surface.levels,
        surface_rows_log2=rows[0],
        surface_finest=resolution.value.surface,
        radiance_levels=recipe.radiance.levels,
        radiance_rows_log2=rows[1],
        radiance_finest=resolution.value.radiance,
        background=background.value,
        far_light=far_light.value,
        light=recipe.radiance.light != "off",
        outer_radius=spheres.value[1],
        surface_hidden=recipe.surface.hidden_width,
        radiance_hidden=recipe.radiance.hidden_width,
        occupancy=recipe.sampling.occupancy_resolution,
        initial_radius=spheres.value[0],
    )
    footprint = facts.footprint * facts.coarser
    sharpness = recipe.schedule.sharpness_per_footprint * resolution.value.sharpness / footprint
    return Needs(
        design=design,
        footprint=footprint,
        sharpness_end=max(sharpness, 2 * recipe.schedule.sharpness_start),
        sharpness_until=recipe.schedule.sharpness_until * _sooner(rays_to_come),
        black_background=not background.value and facts.outside >= _PAST,
        sparse=tuple(n for n, s in share.value.items() if s < 1.0 or n in facts.unmasked),
        few=facts.few,
        directions=directions.value,
        smooth=smooth.value,
        share=share.value,
        choices=choices,
    )


def _masks(f: _Facts) -> Choice[MaskMeaning]:
    """What do the training frames' masks say about the pixels outside?"""
    masked = {n: m for n, m in f.measurements.items() if m.masked}
    if not masked:
        frames = [frame for frame in f.scene.frames if frame.sensor in f.measurements and frame.view in f.scene.split.train]
        having = sum(frame.mask is not None for frame in frames)
        return Choice("off", f"off: {having} of {len(frames)} training frames have one" + (", they only score" if having else ""), False)
    meaning = f.scene.masks
    share = ", ".join(f"{n} {m.pixels / m.total:.1%}" for n, m in masked.items())
    says = {"object": "nothing is outside", "ignore": "what is outside is not learned from"}[meaning]
    why = f"{meaning}: {says}; inside are {share} of the pixels"
    if meaning == "object":
        lost = {n: len(m.origins) - m.masked for n, m in masked.items() if m.masked < len(m.origins)}
        if lost:
            why += f"; {', '.join(f'{count} frames of {n}' for n, count in lost.items())} have no mask and are not learned from"
        if f.unmasked:
            why += f"; {', '.join(f.unmasked)} without masks: learned from the geometry of the others"
    return Choice(meaning, why, True)


def _background(f: _Facts) -> Choice[bool]:
    """Is what lies outside the region modelled?"""
    asked = f.recipe.surface.background
    if asked != "auto":
        return switch(asked == "on", _BY_RECIPE)
    if f.transparent:
        return switch(False, _NOTHING)
    past = f"{f.outside:.1%} of {f.sampled} sampled pixels see past the region of interest"
    if f.outside < _PAST:
        return switch(False, past)
    needed = f.bright > 0.05
    cost = "; costs a grid twice as wide, and rays that go on to the end" if needed else ""
    return switch(needed, f"{past}, {f.bright:.1%} of these are not black{cost}")


def _far_light(f: _Facts, background: bool) -> Choice[bool]:
    """Where the background is not modelled: has what passes the region a colour per direction?"""
    asked = f.recipe.radiance.far_light
    if background:
        return switch(False, "the background is modelled")
    if f.recipe.schedule.decide_at >= 1.0:
        return switch(False, "it is learned once residuals have decided, which the recipe leaves out (decide_at = 1)")
    if asked != "auto":
        return switch(asked == "on", _BY_RECIPE)
    if f.transparent:
        return switch(False, _NOTHING)
    if f.outside < _PAST:
        return switch(False, "nothing is seen past the region of interest")
    return switch(f.light > 0.01, f"what is past it has {f.light:.1%} of the brightest light")


def _resolution(f: _Facts, background: bool) -> Choice[Resolution]:
    """How fine are the grids?"""
    surface, coarser = f.recipe.surface, f.coarser
    footprint = f.footprint * coarser
    # a cell of half a pixel is the finest that any pixel can tell; hashed levels beyond 2048 only collide
    extent = 2 if background else 1  # contracted space is twice as wide
    finest = 2 * extent * surface.cells_per_pixel / footprint
    # geometry that few measurements see bends to each of them; appearance may, it is only looked at from where they were taken
    seen_enough = max(_COARSE, math.sqrt(min(f.pixels, f.rays_to_come) / (_FACES * surface.measurements_per_cell)))
    across = int(np.clip(min(finest, seen_enough), 32, 1024))
    radiance = int(np.clip(2 * extent * f.recipe.radiance.cells_per_pixel / footprint, 64, 2048))
    cells = f"finest cells {2 / across:.2g} (surface), {2 / radiance:.2g} (radiance)"
    seen = f", {coarser:.1f} pixels apart for {f.rays_to_come:.1e} rays on {f.pixels:.1e} pixels" if coarser > 1 else ""
    every = {n: m.every for n, m in f.measurements.items() if m.every > 1}
    kept = (f"one in {k} of {', '.join(n for n in every if every[n] == k)}" for k in sorted(set(every.values())))
    seen += f" (rows kept: {'; '.join(kept)})" if every else ""
    few = f", the surface's for {surface.measurements_per_cell:g} measurements of each" if seen_enough < finest else ""
    why = f"a pixel is {f.footprint:.2g} radii at the centre{seen}: {cells}{few}"
    return Choice(Resolution(across, radiance, min(1.0, seen_enough / finest)), why, bool(seen or few))


def _initial_spheres(f: _Facts, background: bool) -> Choice[tuple[float, float]]:
    """Radii of the sphere that a fit starts from, and of the one around everything, in contracted space."""
    asked = f.recipe.surface
    radius = asked.initial_radius or (0.4 if background else 0.5)
    farthest = max(float(np.linalg.norm(m.origins, axis=1).max()) for m in f.measurements.values())
    # measured: what starts far behind the scene reaches it late, and in streaks
    outer = asked.outer_radius or 2.0 - 1.0 / (_OUTERMOST * max(farthest, 1.0))
    around = f", one around everything at {1 / (2 - outer):.2g} radii" if background else ""
    why = _BY_RECIPE if asked.initial_radius else f"background {'on' if background else 'off'}"
    by_recipe = asked.initial_radius is not None or asked.outer_radius is not None
    return Choice((radius, outer), f"radius {radius:g}: {why}{around}", by_recipe)


def _ray_shares(f: _Facts) -> Choice[dict[str, float]]:
    """Of the rays that each modality gets: 1 where it has enough of the most plentiful one's pixels, else in proportion to its own."""
    pixels = {n: m.pixels for n, m in f.measurements.items()}
    enough = f.recipe.sampling.sparse_below * max(count for n, count in pixels.items() if n not in f.unmasked)
    share = {n: min(1.0, count / enough) if enough else 1.0 for n, count in pixels.items()}
    sparse = ", ".join(f"{n} {len(f.measurements[n].origins)} frames" for n, s in share.items() if s < 1.0)
    why = f"on: {sparse}: learned from the geometry of the others" if sparse else "off: all modalities have enough pixels"
    return Choice(share, why, bool(sparse))


def _directions(f: _Facts) -> Choice[int]:
    """How far may radiance depend on direction? Few views tell as many harmonics apart as they are; what lies between or beside them would
    be painted by chance, and one of them, held out, says little of that."""
    asked = f.recipe.radiance.view_dependence
    if asked != "auto":
        return Choice(asked, f"degree {asked}: {_BY_RECIPE}", asked > 0)
    degree = max((d for d in range(DEGREES + 1) if (d + 1) ** 2 <= f.views), default=0) if f.few else DEGREES
    return Choice(degree, f"degree {degree} at the most: {f.views} training views", f.few)


def _smooth(f: _Facts, background: bool) -> Choice[bool]:
    """Do few views see what lies outside the region?"""
    seen = f"{f.views} training views"
    if not background:
        return switch(False, "no surfaces outside of the region are modelled")
    if not f.few or f.recipe.loss.smooth_weight == 0:
        return switch(False, seen)
    return switch(True, f"{seen}: outside of the region normals of neighbouring places are pulled together")


def _tensor_head(f: _Facts) -> Choice[bool]:
    """Is light a coherency tensor for some sensors?"""
    names = [n for n, m in f.measurements.items() if m.sensor.is_polarization]
    return switch(bool(names), f"{', '.join(names)}; costs six outputs each" if names else "no polarization sensor")


def _table_rows(f: _Facts) -> tuple[int, int]:
    """log2 of the most rows of a level's table, of the surface and of the radiance."""
    surface, radiance = f.recipe.surface, f.recipe.radiance
    if f.recipe.schedule.tables_at == 0:
        return surface.max_rows_log2, radiance.max_rows_log2
    # a row that few rays meet is noise, and costs as much as any other
    rows = lambda grid: rows_log2(f.rays_to_come / grid.rays_per_row, grid.max_rows_log2)
    return rows(surface), rows(radiance)


def _sooner(rays: float) -> float:
    """Share of the time, relative to that of a fit of a minute, in which the surface gets sharp: what it takes to find a shape are steps.

    Measured at a share of 2/3: 300 and 1,200 steps lose 0.5 and 0.15 dB, 5,000 nothing, 12,000 gain 0.4 dB.
    """
    return min(1.0, max(2 / 3, (rays / (60.0 * _RAYS_PER_SECOND)) ** -0.25))


def footprint_of(measurements: Measurements) -> float:
    """Median over frames of a pixel's size at the region's centre, in radii."""
    return float(np.median(np.concatenate([pixel_sizes(m.origins, [m.cameras[c] for c in m.camera_index]) for m in measurements.values()])))


def pixel_sizes(origins: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Of each frame the size of a pixel at the region's centre, in radii (F,); a camera inside counts as one radius away.

    Args:
        origins: (F, 3) of cameras in the normalised frame. cameras: F of them.
    """
    return np.maximum(np.linalg.norm(origins, axis=1), 1.0) / np.array([0.5 * (c.fx + c.fy) for c in cameras])


def _look_outside(measurements: Measurements, random: np.random.Generator) -> tuple[float, float, float, int]:
    """``outside, bright, light, sampled`` of ``_Facts``."""
    misses = bright = rays = 0
    light = 0.0
    for name in measurements:
        batch = draw(measurements, None, {name: _LOOKED_AT}, random)
        origins, directions = batch.origins.cpu().numpy(), batch.directions.cpu().numpy()
        along = np.einsum("ni,ni->n", origins, directions)
        closest = np.linalg.norm(origins - directions * np.minimum(along, 0.0)[:, None], axis=1)
        values = batch.measured.target.cpu().numpy().reshape(_LOOKED_AT, -1).mean(1)
        missing = closest > 1.0
        misses += int(missing.sum())
        high = max(float(np.quantile(values, 0.95)), 1e-12)
        bright += int((values[missing] > 0.25 * high).sum())
        light += float(values[missing].sum()) / high
        rays += _LOOKED_AT
    return misses / rays, bright / max(misses, 1), light / max(misses, 1), rays
