"""Where the cameras look: the region of interest of a scene that does not state it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.checks import number, numbers
from mmsynth.scene.scene import Region, ball
from mmsynth.sensors.camera import Camera, project


def region_from_cameras(cameras: Sequence[Camera], poses: Sequence[np.ndarray]) -> Region:
    """Guess the region of interest of a scene that does not state it.

    Centre: the point nearest to all optical axes (least squares). Radius: the ball there that just fills a frame, median over
    the cameras of distance x sin(half the larger field of view), but at most 0.9 of the distance to the nearest camera, so
    that cameras stay outside; a stray camera nearer than 1/9 of the median does not shrink it further.

    Where the axes have no common point in front of most cameras (one camera, parallel axes, looking outwards), the ball is
    put ahead of the cameras' mean position, along their mean direction, at twice their spread (1 unit for a single
    position), and fills a frame as above. Without a mean direction it is around the cameras' mean position: cameras that face
    each other see it as above, a panorama is inside a ball of twice its spread.

    Args:
        cameras, poses: one per frame; poses (4, 4), OpenCV axes.
    Returns:
        a finite ball with positive radius, in the poses' frame and unit.
    """
    centres = np.stack([pose[:3, 3] for pose in poses])
    axes = np.stack([pose[:3, 2] for pose in poses])
    mean = centres.mean(0)
    half_view = np.array([np.arctan(max(c.width / c.fx, c.height / c.fy) / 2) for c in cameras])  # of the larger side
    point = nearest_to_rays(centres, axes)
    if point is not None and _before(point, centres, axes):
        return _filling(point, centres, half_view)
    reach = 2 * float(np.linalg.norm(centres - mean, axis=1).max())
    reach = reach if reach > 1e-9 * max(1.0, float(np.linalg.norm(mean))) else 1.0  # one position up to rounding
    direction = axes.mean(0)
    length = float(np.linalg.norm(direction))
    if length < 0.5:
        # cameras that face each other along one line, or a panorama
        return _filling(mean, centres, half_view) if _before(mean, centres, axes) else ball(mean, reach)
    return ball(mean + reach * direction / length, reach * float(np.sin(np.median(half_view))))


def nearest_to_rays(origins: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """The point (3,) nearest to all lines, origins and unit directions (N, 3) each (least squares); None where they are almost parallel."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]  # (N, 3, 3): removes the part along each line
    normal = across.mean(0)
    # smallest eigenvalue = mean squared sine between the lines and their common direction: 1e-4 is about half a degree
    if np.linalg.eigvalsh(normal)[0] <= 1e-4:
        return None
    # solved about the mean position: worlds far from their origin (survey coordinates) keep their digits
    mean = origins.mean(0)
    return np.asarray(mean + np.linalg.solve(normal, np.einsum("nij,nj->i", across, origins - mean) / len(origins)))


def _before(point: np.ndarray, centres: np.ndarray, axes: np.ndarray) -> bool:
    """Whether it lies in front of most cameras."""
    return bool(np.mean(np.einsum("ni,ni->n", point - centres, axes) > 0) > 0.5)


def _filling(point: np.ndarray, centres: np.ndarray, half_view: np.ndarray) -> Region:
    """The ball around a point that just fills the frame of a typical camera, and leaves the cameras outside."""
    distance = np.linalg.norm(centres - point, axis=1)
    radius = min(float(np.median(distance * np.sin(half_view))), 0.9 * max(float(distance.min()), float(np.median(distance)) / 9))
    return ball(point, radius)


def region_from_points(points: np.ndarray, seen: Region, positions: np.ndarray) -> Region:
    """A region of interest that fits what is there: the ball around the sparse points that cameras look at.

    Centre: the median of the points within the region that the cameras gave. Radius: 1.1 times the distance within which 95 % of
    them lie, and as far as the cameras' region allows: not larger than it, and cameras that were outside stay outside.

    Args:
        points: (N, 3), of structure from motion. seen: ``region_from_cameras``. positions: (M, 3) of the cameras.
    Returns:
        ``seen`` where fewer than 50 points lie in it.
    """
    centre = np.asarray(seen.centre)
    inside = points[np.linalg.norm(points - centre, axis=1) <= seen.radius]
    if len(inside) < 50:
        return seen
    middle = np.median(inside, axis=0)
    reach = 1.1 * float(np.quantile(np.linalg.norm(inside - middle, axis=1), 0.95))
    outside = positions[np.linalg.norm(positions - centre, axis=1) > seen.radius]
    room = 0.9 * float(np.linalg.norm(outside - middle, axis=1).min()) if len(outside) else reach
    radius = min(reach, seen.radius, room)
    return ball(middle, radius) if radius > 0 else seen


def region_from_silhouettes(
    silhouettes: Sequence[np.ndarray], cameras: Sequence[Camera], poses: Sequence[np.ndarray], seen: Region
) -> Region:
    """The ball around the visual hull (Laurentini 1994): around what lies in the silhouette of every picture that shows it.

    On 48 cells across ``seen``. A cell counts when its ball meets the silhouette in 95 % of the pictures that its centre is in, so that a
    few bad masks carve nothing away.

    Args:
        silhouettes: (H, W) bool, one per camera. seen: ``region_from_cameras``.
    Returns:
        the ball around the centres of these cells and a cell more; ``seen`` where nothing is left or it would be larger.
    """
    count = 48
    step = 2 * seen.radius / count
    axis = (np.arange(count) + 0.5) * step - seen.radius
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    cells = cells[np.linalg.norm(cells, axis=1) <= seen.radius] + np.asarray(seen.centre)
    shown, inside = np.zeros(len(cells), int), np.zeros(len(cells), int)
    for silhouette, camera, pose in zip(silhouettes, cameras, poses, strict=True):
        distance = cv2.distanceTransform((~silhouette).astype(np.uint8), cv2.DIST_L2, 5)  # pixels to the silhouette
        local = (cells - pose[:3, 3]) @ pose[:3, :3]
        pixel = np.rint(project(local, camera)).astype(np.int64)
        there = (local[:, 2] > 0) & (pixel >= 0).all(1) & (pixel < (camera.width, camera.height)).all(1)
        column, row = pixel[there].T
        reach = np.sqrt(3) / 2 * step * max(camera.fx, camera.fy) / np.linalg.norm(local[there], axis=1)
        shown += there
        inside[there] += distance[row, column] <= reach + 1
    full = cells[(shown > 0) & (inside >= 0.95 * shown)]
    if not len(full):
        return seen
    middle = (full.min(0) + full.max(0)) / 2
    radius = float(np.linalg.norm(full - middle, axis=1).max()) + step
    return ball(middle, radius) if radius < seen.radius else seen


def stated_region(meta: Mapping[str, Any], path: Path) -> Region | None:
    """``meta["region"]`` of a file: ``centre`` and ``radius``; None where it has none. Raises InputError: no such ball."""
    if "region" not in meta:
        return None
    where, entry = f"{path}: key 'region'", meta["region"]
    complaint = f"{where} is {entry!r}, expected an object with 'centre', three numbers, and 'radius'."
    centre = numbers(entry.get("centre") if isinstance(entry, dict) else None, complaint)
    if centre.shape != (3,) or not np.isfinite(centre).all():
        raise InputError(complaint)
    radius = number(entry, "radius", where, low=0.0)
    if radius == 0:
        raise InputError(f"{where}: radius 0, expected a positive number.")
    return ball(centre, radius)
