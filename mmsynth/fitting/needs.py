"""What this scene needs: sizes and parts decided from the cameras and pixels, with the evidence kept.

Model only what a scene needs: no background where nothing but black lies behind the region of interest, no tensor head
without a polarization sensor (heads follow the sensors), no grid level finer than a pixel.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mmsynth.field.field import Design
from mmsynth.fitting.measurements import Measurements
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.table_sizes import rows_log2
from mmsynth.scene.scene import Scene

_FACES = 6  # of a cube: the cells that a surface may occupy, in units of the resolution squared
_HORIZON = 2.0  # distance of the farthest camera, at which the sphere around everything stands at the start
_COARSE = 128  # cells across the grid that a surface may have however few the measurements: small pictures show large things


@dataclass(frozen=True)
class Needs:
    """The choice and why.

    Attributes:
        footprint: the finest detail to expect at the region's centre, in radii.
        scarce: modalities with so few pixels that they would spoil what others know better: they learn their colours from the
            geometry and appearance of the others. share: of the rays that each modality gets, relative to a plentiful one.
        evidence: one line per choice.
    """

    design: Design
    footprint: float
    sharpness_end: float
    black_background: bool
    scarce: tuple[str, ...]
    share: dict[str, float]
    evidence: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def assess(scene: Scene, measurements: dict[str, Measurements], recipe: Recipe, seed: int, rays_to_come: float) -> Needs:
    """Look at the cameras and at 4096 random pixels per modality.

    Args:
        rays_to_come: about how many rays the fit will see. When that is fewer than there are pixels, what it can learn is
            coarser than a pixel, by the square root of the ratio.
    """
    pixels = sum(int(m.ends[-1]) for m in measurements.values())
    coarser = max(1.0, math.sqrt(pixels / rays_to_come))
    footprint = _footprint(measurements) * coarser
    outside, bright, light, rays = _look_outside(measurements, np.random.default_rng((seed, 7)))
    evidence = {}
    if recipe.surface.background != "auto":
        background = recipe.surface.background == "on"
        evidence["background"] = f"{recipe.surface.background}: asked for by the recipe"
    elif scene.black_background or any(m.has_alpha for m in measurements.values()):
        background = False
        evidence["background"] = "off: the input says that it is black or transparent"
    elif outside < 0.005:
        background = False
        evidence["background"] = f"off: {outside:.1%} of {rays} sampled pixels see past the region of interest"
    else:
        background = bright > 0.05
        verdict = "on" if background else "off"
        past = f"{outside:.1%} of {rays} sampled pixels see past the region of interest"
        cost = "; costs a grid twice as wide, and rays that go on to the end" if background else ""
        evidence["background"] = f"{verdict}: {past}, {bright:.1%} of these are not black{cost}"
    dim = "nothing is seen past the region of interest" if outside < 0.005 else f"what is past it has {light:.1%} of the brightest light"
    if background:
        beyond, evidence["beyond"] = False, "off: the background is modelled"
    elif recipe.schedule.decide_at >= 1.0:
        beyond, evidence["beyond"] = False, "off: it is learned once residuals have decided, which the recipe leaves out (decide_at = 1)"
    elif recipe.radiance.far_light != "auto":
        beyond, evidence["beyond"] = recipe.radiance.far_light == "on", f"{recipe.radiance.far_light}: asked for by the recipe"
    elif scene.black_background or any(m.has_alpha for m in measurements.values()):
        beyond, evidence["beyond"] = False, "off: the input says that it is black or transparent"
    else:
        beyond = outside >= 0.005 and light > 0.01
        evidence["beyond"] = f"{'on' if beyond else 'off'}: {dim}"
    # a cell of half a pixel is the finest that any pixel can tell; hashed levels beyond 2048 only collide
    extent = 2 if background else 1  # contracted space is twice as wide
    finest = 2 * extent * recipe.surface.cells_per_pixel / footprint
    # geometry that few measurements see bends to each of them; appearance may, it is only looked at from where they were taken
    seen_enough = max(_COARSE, math.sqrt(min(pixels, rays_to_come) / (_FACES * recipe.surface.measurements_per_cell)))
    surface_finest = int(np.clip(min(finest, seen_enough), 32, 1024))
    radiance_finest = int(np.clip(2 * extent * recipe.radiance.cells_per_pixel / footprint, 64, 2048))
    cells = f"finest cells {2 / surface_finest:.2g} (surface), {2 / radiance_finest:.2g} (radiance)"
    seen = f", {coarser:.1f} pixels apart for {rays_to_come:.1e} rays on {pixels:.1e} pixels" if coarser > 1 else ""
    few = f", the surface's for {recipe.surface.measurements_per_cell:g} measurements of each" if seen_enough < finest else ""
    evidence["resolution"] = f"a pixel is {footprint / coarser:.2g} radii at the centre{seen}: {cells}{few}"
    radius = recipe.surface.initial_radius or (0.4 if background else 0.5)
    farthest = max(float(np.linalg.norm(m.origins, axis=1).max()) for m in measurements.values())
    # measured: what starts far behind the scene reaches it late, and in streaks
    horizon = recipe.surface.outer_radius or 2.0 - 1.0 / (_HORIZON * max(farthest, 1.0))
    around = f", one around everything at {1 / (2 - horizon):.2g} radii" if background else ""
    why = "asked for by the recipe" if recipe.surface.initial_radius else f"background {'on' if background else 'off'}"
    evidence["initial_sphere"] = f"radius {radius:g}: {why}{around}"
    share = _shares(measurements, recipe.sampling.sparse_below)
    scarce = tuple(n for n, s in share.items() if s < 1.0)
    frames = ", ".join(f"{n} {len(measurements[n].origins)} frames" for n in scarce)
    evidence["scarce"] = f"on: {frames}: learned from the geometry of the others" if scarce else "off: all modalities have enough pixels"
    pol = [n for n, m in measurements.items() if m.sensor.is_polarization]
    evidence["tensor_head"] = f"on: {', '.join(pol)}; costs six outputs each" if pol else "off: no polarization sensor"
    surface_rows, radiance_rows = recipe.surface.max_rows_log2, recipe.radiance.max_rows_log2
    if recipe.schedule.tables_at == 0:
        evidence["tables"] = f"2^{surface_rows} and 2^{radiance_rows} rows a level: asked for by the recipe"
    else:
        # a row that few rays meet is noise, and costs as much as any other
        surface_rows = rows_log2(rays_to_come / recipe.surface.rays_per_row, surface_rows)
        radiance_rows = rows_log2(rays_to_come / recipe.radiance.rays_per_row, radiance_rows)
    design = Design(
        surface_levels=recipe.surface.levels,
        surface_rows_log2=surface_rows,
        surface_finest=surface_finest,
        radiance_levels=recipe.radiance.levels,
        radiance_rows_log2=radiance_rows,
        radiance_finest=radiance_finest,
        background=background,
        far_light=beyond,
        outer_radius=horizon,
        surface_hidden=recipe.surface.hidden_width,
        radiance_hidden=recipe.radiance.hidden_width,
        occupancy=recipe.sampling.occupancy_resolution,
        initial_radius=radius,
    )
    black = not background and outside >= 0.005
    sharpness = recipe.schedule.sharpness_per_footprint * min(1.0, seen_enough / finest) / footprint
    return Needs(design, footprint, max(sharpness, 2 * recipe.schedule.sharpness_start), black, scarce, share, evidence)


def _shares(measurements: dict[str, Measurements], below: float) -> dict[str, float]:
    """1 for a modality with at least ``below`` of the pixels of the one that has most, else in proportion to its pixels."""
    pixels = {n: int(m.ends[-1]) for n, m in measurements.items()}
    enough = below * max(pixels.values())
    return {n: min(1.0, count / enough) if enough else 1.0 for n, count in pixels.items()}


def _footprint(measurements: dict[str, Measurements]) -> float:
    """Median over frames of a pixel's size at the region's centre, in radii; a camera inside counts as one radius away."""
    sizes = []
    for m in measurements.values():
        focal = np.array([0.5 * (m.cameras[c].fx + m.cameras[c].fy) for c in m.camera_index])
        sizes.append(np.maximum(np.linalg.norm(m.origins, axis=1), 1.0) / focal)
    return float(np.median(np.concatenate(sizes)))


def _look_outside(measurements: dict[str, Measurements], random: np.random.Generator) -> tuple[float, float, float, int]:
    """Share of pixels whose ray misses the region; of these the share that is bright and the mean, relative to bright pixels; how many."""
    misses = bright = rays = 0
    light = 0.0
    for m in measurements.values():
        frame, pixel = m.pick(4096, random)
        origins, directions = m.rays(frame, pixel)
        along = np.einsum("ni,ni->n", origins, directions)
        closest = np.linalg.norm(origins - directions * np.minimum(along, 0.0)[:, None], axis=1)
        values = m.read(frame, pixel)[0].mean(1)
        missing = closest > 1.0
        misses += int(missing.sum())
        high = max(float(np.quantile(values, 0.95)), 1e-12)
        bright += int((values[missing] > 0.25 * high).sum())
        light += float(values[missing].sum()) / high
        rays += len(frame)
    return misses / rays, bright / max(misses, 1), light / max(misses, 1), rays
