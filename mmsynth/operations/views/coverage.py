"""How well what a view sees was seen by the training frames.

Coverage of a surface point X, with unit normal n, that a view sees from O with focal length f [px]: the best of the training frames j
(centre O_j, focal length f_j) that see X,

    coverage = max_j  max(0, 1 - α_j / 90°) · min(1, √(A / A_j))

    α_j    angle at X between the directions to O and to O_j
    A      area of the surface around X that one pixel sees: (|X - O| / f)² / cos θ, where θ is the angle between n and the direction to O
    A_j    the same of the training frame: (|X - O_j| / f_j)² / cos θ_j

So 1 means that a training ray looks along the same line at the same or a finer resolution; 0.9 that the nearest ray is 9° away, or that
the pixels that saw the point were 1.1 times as wide as the view's; 0 that nobody saw it, or only from more than 90° away. The terms are
those of unstructured lumigraphs (Buehler et al. 2001: angle and resolution), multiplied.

A frame sees X where n faces it (cos θ_j > 0), its lens projects X into the frame, and nothing stands before X: a depth map of the field
from that frame says so (``visibility``). Those maps are small, and made once per field: ``training_rays``. f is √(fx fy): how a lens
stretches its image away from the axis is left out.

Pixels without a surface have no coverage, NaN: there is no point that a training frame could have seen, and where the light of a ray
comes from is all that coverage speaks of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mmsynth.errors import InputError
from mmsynth.operations.output.progress import Progress
from mmsynth.operations.views.visibility import hidden, inside, towards
from mmsynth.parallel import side_by_side
from mmsynth.scene.scene import PosedCamera, Scene
from mmsynth.sensors.camera import Camera, project, resized, surface_points, unproject

if TYPE_CHECKING:
    from mmsynth.field.field import Field

MAP_WIDTH = 80  # px, of the depth maps of the training frames
SCORE_WIDTH = 32  # rays in a row, to score a view
_PAIRS = 4_000_000  # of points and frames at a time: 32 MB per array
_BLOCK = 50_000  # of them while the arithmetic is done: what it takes stays in the cache, which makes it ten times as fast
_MARGIN = 1  # px that the maps reach beyond the frames: their outermost pixels are not centred on the frames' edges


@dataclass(frozen=True)
class TrainingRays:
    """Where J training frames looked from, and how far they saw.

    Attributes:
        poses: (J, 4, 4) camera_to_world as the fit corrected them. focal: (J,) √(fx fy) [px].
        cone: (J,) cosine of an angle off the optical axis beyond which the frame sees nothing.
        cameras: those of the frames, each once. camera_of: (J,) index into them. place: (J,) which depth map of that camera.
        small: per camera, the one of its depth maps. depth_ray: per camera (J', h, w) float32, along the ray; NaN = no surface.
    """

    poses: np.ndarray
    focal: np.ndarray
    cone: np.ndarray
    cameras: tuple[Camera, ...]
    camera_of: np.ndarray
    place: np.ndarray
    small: tuple[Camera, ...]
    depth_ray: tuple[np.ndarray, ...]


def training_rays(field: Field, scene: Scene, *, modalities: Sequence[str] | None = None, progress: Progress | None = None) -> TrainingRays:
    """Depth maps of the training frames, rendered once per field.

    Args:
        scene: the one that the field was fitted to. modalities: whose frames count; None: those of all sensors of the field.
        progress: called with (frames done, frames in all).
    Raises:
        InputError: a modality that the field does not know, or no training frame of them.
    """
    names = field.check_modalities(modalities)
    frames = [frame for frame in scene.frames if frame.sensor in names and frame.view in scene.split.train]
    if not frames:
        raise InputError(f"{scene.root}: no training frames of {', '.join(names)}, expected at least one to judge views by.")
    cameras = tuple(dict.fromkeys(frame.camera for frame in frames))
    small = tuple(resized(camera, min(MAP_WIDTH, camera.width), _MARGIN) for camera in cameras)
    camera_of = np.array([cameras.index(frame.camera) for frame in frames])
    maps: list[list[np.ndarray]] = [[] for _ in cameras]
    place = np.empty(len(frames), np.int64)
    for index, (frame, which) in enumerate(zip(frames, camera_of, strict=True)):
        place[index] = len(maps[which])
        maps[which].append(field.render(small[which], field.pose_of(frame), [], geometry=True).depth_ray)
        if progress is not None:
            progress(index + 1, len(frames))
    return TrainingRays(
        poses=np.stack([field.pose_of(frame) for frame in frames]),
        focal=np.array([_focal(frame.camera) for frame in frames]),
        cone=np.array([_cone(camera) for camera in cameras])[camera_of],
        cameras=cameras,
        camera_of=camera_of,
        place=place,
        small=small,
        depth_ray=tuple(np.stack(of_camera) for of_camera in maps),
    )


def coverage(rays: TrainingRays, view: PosedCamera, depth_ray: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Coverage of every pixel of a rendered view (definition: module docstring).

    Args:
        depth_ray: (H, W), scene unit. normal: (H, W, 3), world frame; both NaN = no surface.
    Returns:
        (H, W) float32 in [0, 1], NaN = no surface.
    """
    return _coverage(rays, view, _focal(view.camera), depth_ray, normal)


def coverage_of_point(frames: Sequence[tuple[np.ndarray, Camera]], view: PosedCamera, point: np.ndarray, normal: np.ndarray) -> float:
    """Coverage of one surface point (3,) that a view sees, by frames that see it (``visibility``): pose (4, 4) and camera of each."""
    if not frames:
        return 0.0
    cameras = tuple(camera for _, camera in frames)
    rays = TrainingRays(
        poses=np.stack([pose for pose, _ in frames]),
        focal=np.array([_focal(camera) for camera in cameras]),
        cone=np.full(len(frames), -1.0),
        cameras=cameras,
        camera_of=np.arange(len(frames)),
        place=np.zeros(len(frames), np.int64),
        small=cameras,
        depth_ray=(),
    )
    centre = view.camera_to_world[:3, 3]
    facing = towards(normal[None], point[None], centre)
    return float(_closeness(rays, (point - centre)[None], facing, centre, _focal(view.camera)).max())


def view_score(field: Field, rays: TrainingRays, view: PosedCamera) -> float:
    """Mean coverage of what a view sees, in [0, 1], by a sparse grid of its rays; 0 for a view that sees no surface at all.

    The view is not rendered for it: 32 rays in a row, and as many rows as keep them square.
    """
    sparse = replace(view, camera=resized(view.camera, min(SCORE_WIDTH, view.camera.width)))
    seen = field.render(sparse.camera, sparse.camera_to_world, [], geometry=True)
    covered = _coverage(rays, sparse, _focal(view.camera), seen.depth_ray, seen.normal)
    hit = np.isfinite(covered)
    return float(covered[hit].mean(dtype=np.float64)) if hit.any() else 0.0


def view_scores(field: Field, rays: TrainingRays, views: Sequence[PosedCamera], *, progress: Progress | None = None) -> list[float]:
    """``view_score`` of each view; progress is called with (views done, views in all)."""
    scores = []
    for view in views:
        scores.append(view_score(field, rays, view))
        if progress is not None:
            progress(len(scores), len(views))
    return scores


def covered_views(views: Sequence[PosedCamera], scores: Sequence[float], least: float) -> tuple[list[PosedCamera], list[tuple[str, float]]]:
    """Views with a score of at least ``least``, and name and score of the others.

    Raises:
        InputError: no view has that score.
    """
    kept = [view for view, score in zip(views, scores, strict=True) if score >= least]
    if not kept:
        raise InputError(
            f"coverage: the best of {len(views)} views has {max(scores, default=0.0):.3f}, expected one with {least:g} or more."
        )
    return kept, [(view.name, score) for view, score in zip(views, scores, strict=True) if score < least]


def _focal(camera: Camera) -> float:
    return float(np.sqrt(camera.fx * camera.fy))


def _cone(camera: Camera) -> float:
    """Cosine of the largest angle off the axis in the frame, by its edge; -1 where the lens has no rays at some of that."""
    u, v = np.linspace(-0.5, camera.width - 0.5, 65), np.linspace(-0.5, camera.height - 0.5, 65)
    across, down = np.zeros_like(u), np.zeros_like(v)
    edges = [(u, down - 0.5), (u, down + camera.height - 0.5), (across - 0.5, v), (across + camera.width - 0.5, v)]
    directions, valid = unproject(np.concatenate([np.stack(edge, 1) for edge in edges]), camera)
    return float(directions[:, 2].min()) - 1e-3 if valid.all() else -1.0  # the edge between the samples


def _coverage(rays: TrainingRays, view: PosedCamera, focal: float, depth_ray: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """``coverage`` of pixels that stand for a view with another focal length: of a sparse grid of its rays."""
    out = np.full(depth_ray.shape, np.nan, np.float32)
    hit = np.isfinite(depth_ray)
    points, centre = surface_points(view.camera, view.camera_to_world, depth_ray)[hit], view.camera_to_world[:3, 3]
    normals = towards(normal[hit], points, centre)
    step = max(1, _PAIRS // len(rays.poses))
    parts = [slice(start, start + step) for start in range(0, len(points), step)]
    best = [found for _, found in side_by_side(lambda part: _best(rays, points[part], normals[part], centre, focal), parts)]
    out[hit] = np.concatenate(best) if best else 0.0
    return out


def _best(rays: TrainingRays, points: np.ndarray, normals: np.ndarray, centre: np.ndarray, focal: float) -> np.ndarray:
    """Coverage of points (N, 3) with normals (N, 3) towards the view: (N,) float64.

    The frames are asked in the order of what they could give, so that most points need one depth map, and the answer is exact.
    """
    could = np.empty((len(points), len(rays.poses)))
    step = max(1, _BLOCK // len(rays.poses))
    for start in range(0, len(points), step):
        block = slice(start, start + step)
        could[block] = _closeness(rays, points[block] - centre, normals[block], centre, focal)
    best = np.zeros(len(points))
    waiting, order = np.arange(len(points)), could.argmax(1)[:, None]  # of all frames only where the first does not see the point
    start, size = 0, 1
    while len(waiting) and start < could.shape[1]:
        frames = order[:, start : start + size]
        worth = could[waiting[:, None], frames]
        at, rank = np.nonzero(worth > 0)
        seen = np.zeros(worth.shape, bool)
        seen[at, rank] = _sees(rays, frames[at, rank], points[waiting[at]])
        best[waiting] = np.where(seen, worth, 0.0).max(1)
        more = ~seen.any(1) & (worth[:, -1] > 0)
        waiting = waiting[more]
        order = np.argsort(-could[waiting], axis=1, kind="stable") if start == 0 else order[more]  # the first is that of argmax
        start, size = start + size, 4 * size
    return best


def _closeness(rays: TrainingRays, offsets: np.ndarray, normals: np.ndarray, centre: np.ndarray, focal: float) -> np.ndarray:
    """What each frame would give if nothing stood in its way: (N, J) float64, 0 where the surface faces away from it or it looks past.

    Args:
        offsets: (N, 3) of the points from the view's centre: their differences keep their digits far from the world's origin.
    """
    centres = rays.poses[:, :3, 3] - centre
    square = np.einsum("ni,ni->n", offsets, offsets)[:, None]
    facing = -np.einsum("ni,ni->n", normals, offsets)[:, None]
    along = square - offsets @ centres.T  # |X - O| |X - O_j| cos α_j
    facing_j = normals @ centres.T + facing  # |X - O_j| cos θ_j
    possible = (along > 0) & (facing_j > 0)
    out = np.zeros(possible.shape)
    some = np.flatnonzero(possible.any(0))  # of the frames around an object, half
    centres, along, facing_j, possible = centres[some], along[:, some], facing_j[:, some], possible[:, some]
    square_j = 2 * along - square + np.einsum("ji,ji->j", centres, centres)
    distance, distance_j = np.sqrt(square), np.sqrt(square_j)
    axes = rays.poses[some, :3, 2]
    possible &= offsets @ axes.T - np.einsum("ji,ji->j", centres, axes) >= rays.cone[some] * distance_j
    cosine = np.clip(along / (distance * distance_j), -1.0, 1.0)  # beyond by rounding alone
    # A / A_j = cos θ_j (|X - O| / f)² / (cos θ (|X - O_j| / f_j)²); cos θ may be 0, and then any frame is fine enough
    pixel = facing_j * (square * distance * rays.focal[some] ** 2)
    pixel_j = (facing * focal**2) * (square_j * distance_j)
    coarser = possible & (pixel < pixel_j)
    ratio = np.divide(pixel, pixel_j, out=np.ones_like(pixel), where=coarser)
    out[:, some] = np.where(possible, (1.0 - np.arccos(cosine) / (np.pi / 2)) * np.sqrt(ratio), 0.0)
    return out


def _sees(rays: TrainingRays, frames: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether frames (P,) see points (P, 3), one each: within the image through the lens, with nothing before them. (P,) bool."""
    seen = np.zeros(len(points), bool)
    camera_of = rays.camera_of[frames]
    for which in np.unique(camera_of):
        here = np.flatnonzero(camera_of == which)
        pose = rays.poses[frames[here]]
        local = np.einsum("pji,pj->pi", pose[:, :3, :3], points[here] - pose[:, :3, 3])
        pixels = project(local, rays.cameras[which])
        within = inside(pixels, rays.cameras[which])
        here, local, pixels = here[within], local[within], pixels[within]
        full, small = rays.cameras[which], rays.small[which]
        scale = np.array([small.fx / full.fx, small.fy / full.fy])
        on_map = (pixels + 0.5) * scale - 0.5 + _MARGIN
        seen[here] = ~hidden(np.linalg.norm(local, axis=1), on_map, rays.depth_ray[which], rays.place[frames[here]])
    return seen
