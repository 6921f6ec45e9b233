"""Cameras that a fit did not learn from, put where its field shows what they saw.

A fit that moves cameras takes its field along with them: by what all of them were off in common, which nothing in their frames tells. So
cameras of other views are off by that, and by what they were off themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from mmsynth.fitting import motions as poses
from mmsynth.fitting.measurements import draw, measure
from mmsynth.fitting.needs import footprint_of
from mmsynth.fitting.refinement import AT_ONCE, PRIOR, put, ray_residuals, rays_of_batch
from mmsynth.scene.scene import Frame, Scene

if TYPE_CHECKING:
    from mmsynth.field.field import Field

_PER_FRAME = 4096  # rays of a look
_LOOKS = 12  # at most
_SMALL = 0.02  # px, a step after which there is no other


@dataclass(frozen=True)
class Placed:
    """Cameras by what they saw: ``poses`` by sensor and view, (4, 4) camera_to_world; ``pixels`` by view, how far off they were [px]."""

    poses: dict[tuple[str, int], np.ndarray]
    pixels: dict[int, float]


def place(field: Field, scene: Scene, frames: Sequence[Frame]) -> Placed:
    """Move the views of some frames of a scene, each with all its sensors, until the field shows best what they saw.

    Gauss-Newton steps, each as long as rays confirm that it was not learned from; see ``fitting.motions``.
    """
    if not frames:
        return Placed({}, {})
    of_sensors = {
        name: (sensor, tuple(replace(f, camera_to_world=field.pose_of(f)) for f in frames if f.sensor == name))
        for name, sensor in scene.sensors.items()
    }
    measurements = measure({n: of for n, of in of_sensors.items() if of[1]}, scene.region, scene.masks, device=field.device)
    level = torch.tensor([field.radiance_scale[n] for n in measurements.order], device=field.device)  # not what these frames have
    measurements.modalities = measurements.modalities._replace(level=level)
    listed = [f for n in measurements.order for f in of_sensors[n][1]]
    layout = poses.layout_of(listed, measurements.order, scene.region)
    motions = poses.Motions(np.zeros((len(layout.views), 6)), np.zeros((len(layout.sensors), 6)))
    prior = PRIOR * footprint_of(measurements)
    counts, random = rays_of_batch(measurements), np.random.default_rng(0)
    for _ in range(_LOOKS):
        now = put(measurements, layout, motions)
        batches = (draw(measurements, field.shader.columns, counts, random) for _ in range(-(-_PER_FRAME * len(listed) // AT_ONCE)))
        seen = ray_residuals(field, batches, lambda batch: None, field.far_light is not None, field.sampling)
        equations = poses.normal_equations(seen, now)
        if not equations.usable:
            break
        step = poses.step_of_each_view(equations, layout, motions, prior)
        motions = poses.follow(motions, step)
        if _pixels(layout, step).max() < _SMALL:
            break
    in_scene = poses.moved(layout, motions)
    in_scene[:, :3, 3] = scene.region.radius * in_scene[:, :3, 3] + np.array(scene.region.centre)
    return Placed(
        {(f.sensor, f.view): pose for f, pose in zip(listed, in_scene, strict=True)},
        dict(zip(layout.views, _pixels(layout, motions).tolist(), strict=True)),
    )


def _pixels(layout: poses.Layout, motions: poses.Motions) -> np.ndarray:
    """(V,) root mean square displacements of the region in the pictures of the views."""
    return np.sqrt(np.einsum("vi,vij,vj->v", motions.views, layout.pixels[layout.anchor], motions.views))
