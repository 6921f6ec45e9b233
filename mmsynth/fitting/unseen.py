"""Space that no picture tells of: right before the cameras, and where nothing that is there was ever met."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Collection, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from mmsynth.field import kernels
from mmsynth.field.field import Field
from mmsynth.field.rendering import beginning
from mmsynth.fitting.measurements import Measurements, Modality, draw
from mmsynth.parallel import side_by_side
from mmsynth.sensors.camera import Camera, project, unproject
from mmsynth.threads import kernel_threads

Solid = Callable[[np.ndarray], np.ndarray]  # points (N, 3) of the normalised frame → (N,) bool; called by several threads at once
_AT_ONCE = 1 << 20  # pairs of a cell and a camera
_POINTS_AT_ONCE = 1 << 11  # on a GPU, of which the definition keeps all corners of all levels, in each thread
_RAYS, _RAYS_AT_ONCE = 1 << 17, 1 << 15  # that look for surfaces
_LEAST_SHARE = 0.05  # of a ray's light, which a surface must give to be met
_AROUND = 2  # cells around one in which a surface is met, in which it may go on


@torch.no_grad()
def unmet_cells(field: Field, measurements: Measurements, random: np.random.Generator) -> Tensor:
    """Cells with matter in which random training rays, and in two cells around, meet no surface.

    Where pictures say that there is nothing outside of the object, rays carve it out of the sphere that a fit starts from. What they never
    reach, beneath a table that is seen from above, stays what it was, and a new view from below would see it: a ghost.

    Args:
        field: finished, with the occupancy of its distance.
    Returns:
        (G, G, G) bool.
    """
    states = field.occupancy.states
    met = torch.zeros_like(states, dtype=torch.bool)
    half, last = len(states) / (2.0 * field.occupancy.extent), len(states) - 1
    for _ in range(_RAYS // _RAYS_AT_ONCE):
        batch = draw(measurements, None, dict.fromkeys(measurements, max(1, _RAYS_AT_ONCE // len(measurements))), random)
        hits = field.trace(batch.origins, batch.directions, field.sampling)
        ray = kernels.rays_of(hits.behind, len(hits.share))
        points = field.surface.grid.to_grid(batch.origins[ray] + batch.directions[ray] * hits.distance[:, None])
        cells = ((points[(hits.share > _LEAST_SHARE) & (hits.distance > 0)] + field.occupancy.extent) * half).long().clamp(0, last)
        met[cells.unbind(-1)] = True
    near = max_pool3d(met[None, None].float(), 2 * _AROUND + 1, 1, _AROUND)[0, 0] > 0
    return (states < kernels.OUTSIDE) & ~near


def solid_of(field: Field) -> Solid:
    """Where a field is solid, as it is rendered; by what several threads may call at once."""
    network = field.surface.at(field.sampling.active_surface)

    @torch.no_grad()
    def solid(points: np.ndarray) -> np.ndarray:
        at = kernels.contract(torch.from_numpy(points.astype(np.float32)).to(field.device))
        if at.is_cpu:  # Triton's kernels are called by one thread alone
            return kernels.surface_value(at, *network).numpy() <= 0.0
        values = [kernels.reference.surface_value(part, *network) for part in at.split(_POINTS_AT_ONCE)]
        return torch.cat(values).numpy(force=True) <= 0.0

    return solid


def unseen_before_cameras(modalities: Collection[Modality], resolution: int, solid: Solid) -> np.ndarray:
    """Cells of contracted space that are nearer to a training camera than its rays begin, and that no training picture sees whole.

    That rays begin there says that nothing is before; where other cameras see something all the same, they are right. But what nobody sees
    is what the surface happens to be there, and a new view whose rays begin nearer would see it: a ghost. Nor are those right whose rays
    begin in something solid: at the border of their pictures, where no other camera looks, they painted on it what is far behind. In the
    region of interest are no such cells.

    Args:
        resolution: cells along each axis of [-2, 2]³. solid: where the field is, see ``solid_of``.
    Returns:
        (G, G, G) bool.
    """
    origins = np.concatenate([m.origins for m in modalities]).astype(np.float64)
    begins = beginning(torch.from_numpy(origins)).numpy()
    rotations = np.concatenate([m.rotations for m in modalities]).astype(np.float64)
    cameras = [m.cameras[c] for m in modalities for c in m.camera_index]
    views = list(zip(cameras, rotations, origins, begins, strict=True))
    parts = np.array_split(np.arange(resolution**3), -(-(resolution**3) * len(origins) // _AT_ONCE))
    before = side_by_side(lambda part: _before_cameras(part, resolution, origins, begins), parts)
    number, points, size = (np.concatenate(x) for x in zip(*(found for _, found in before), strict=True))
    groups = min(kernel_threads(), len(views))  # a cell that one of its views has seen is not asked again
    by_group = side_by_side(lambda i: _seen_whole(points, size, views[i::groups], solid), range(groups))
    seen = np.any([found for _, found in by_group], axis=0)
    unseen = np.zeros(resolution**3, bool)
    unseen[number[~seen]] = True
    return unseen.reshape((resolution,) * 3)


def _before_cameras(number: np.ndarray, resolution: int, origins: np.ndarray, begins: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of numbered cells those that are nearer to a camera than its rays begin: numbers (N,), centres (N, 3), half a diagonal (N,)."""
    cells = (np.stack(np.unravel_index(number, (resolution,) * 3), -1) + 0.5) * (4.0 / resolution) - 2.0
    contracted = np.sqrt(np.einsum("ni,ni->n", cells, cells))
    reach = float((np.linalg.norm(origins, axis=1) + begins).max())  # nothing is before a camera beyond it
    outside = (contracted > 1.0) & (contracted < 2.0 - 1.0 / reach)
    number, cells, contracted = number[outside], cells[outside], contracted[outside, None]
    away = 1.0 / (2.0 - contracted)  # from the centre
    points = cells / contracted * away
    # |p - o|² < b² for some camera, by one product for all cameras: p² + min (o² - b² - 2 p·o) < 0
    of_cameras = np.vstack([-2.0 * origins.T, np.einsum("ni,ni->n", origins, origins) - begins**2])
    nearest = (np.hstack([points, np.ones((len(points), 1))]) @ of_cameras).min(1)
    before = np.einsum("ni,ni->n", points, points) + nearest < 0.0
    # along the radius, where contracted space is stretched most
    return number[before], points[before], np.sqrt(3.0) * 2.0 / resolution * away[before, 0] ** 2


def _seen_whole(
    points: np.ndarray, size: np.ndarray, views: Sequence[tuple[Camera, np.ndarray, np.ndarray, float]], solid: Solid
) -> np.ndarray:
    """Which cells (N,), by centres (N, 3) and half diagonals (N,), are whole in a picture and beyond where its rays begin, in the open.

    Args:
        views: camera, rotation (3, 3) and origin (3,) of each, and where its rays begin.
    """
    seen, squared = np.zeros(len(points), bool), np.einsum("ni,ni->n", points, points)
    for camera, rotation, origin, begin in views:
        widest, left = _widest(camera), np.flatnonzero(~seen)
        # most cells are not before a camera, as their distances from it and along its axis tell
        along, apart = (points[left] @ np.stack([rotation[:, 2], -2.0 * origin], 1)).T
        away = np.sqrt(np.maximum(squared[left] + apart + origin @ origin, 0.0))
        kept = (along - origin @ rotation[:, 2] > widest * away) & (away - size[left] >= begin)
        asked, away = left[kept], away[kept]
        local = (points[asked] - origin) @ rotation
        pixels, margin = project(local, camera), max(camera.fx, camera.fy) * size[asked] / away
        last = np.array([camera.width, camera.height]) - 1.0
        whole = np.minimum(pixels, last - pixels).min(1) > margin  # not where the lens has no pixel: NaN
        asked = asked[whole]
        begins = origin + (points[asked] - origin) * (begin / away[whole])[:, None]
        seen[asked] = ~solid(begins)
    return seen


@functools.lru_cache(maxsize=256)
def _widest(camera: Camera) -> float:
    """Cosine of the widest angle between the axis and the border of a picture, -inf where that is a right angle or more, or unknown."""
    u, v = np.linspace(0.0, camera.width - 1.0, 64), np.linspace(0.0, camera.height - 1.0, 64)
    sides = [(u, np.full(64, end)) for end in v[[0, -1]]] + [(np.full(64, end), v) for end in u[[0, -1]]]
    directions, valid = unproject(np.stack([np.concatenate(x) for x in zip(*sides, strict=True)], -1), camera)
    return float(directions[:, 2].min()) if valid.all() and directions[:, 2].min() > 0 else -math.inf
