"""Calibration boards in the pictures of a scene whose poses are known: things to look at usually stand on them or between them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.images import read_image
from mmsynth.scene.scene import Frame
from mmsynth.sensors.camera import project, unproject

_DICTIONARIES = (cv2.aruco.DICT_4X4_1000, cv2.aruco.DICT_5X5_1000, cv2.aruco.DICT_6X6_1000, cv2.aruco.DICT_7X7_1000)
_LOOK, _MOST = 4, 16  # frames that are looked at before the search is given up, and at the most
_WIDTH = 1000  # pixels: larger pictures are made smaller
_VIEWS = 3  # that must agree on a corner
_APART = 2.0  # pixels (of the smaller picture) by which they may disagree

Sighting = tuple[Frame, np.ndarray]


def board_points(frames: Sequence[Frame]) -> np.ndarray:
    """Corners of ArUco markers (those of ChArUco boards, too), triangulated: (N, 3) in the poses' frame; N = 0 where there are none.

    A corner counts where at least three views see it and it projects to within two pixels of where they do: chance finds do not.

    Args:
        frames: of a sensor without a mosaic. Up to 16 of them are searched, evenly spread, and no more when 4 show no marker.
    """
    order = np.linspace(0, len(frames) - 1, min(_MOST, len(frames))).round().astype(int)
    spread = np.linspace(0, len(order) - 1, min(_LOOK, len(order))).round().astype(int)
    sightings: dict[tuple[int, int, int], list[Sighting]] = defaultdict(list)
    for i in order[spread]:
        _look(frames[i], sightings)
    if not sightings:
        return np.empty((0, 3))
    for i in np.delete(order, spread):
        _look(frames[i], sightings)
    points = [point for seen in sightings.values() if (point := _triangulated(seen)) is not None]
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def _look(frame: Frame, sightings: dict[tuple[int, int, int], list[Sighting]]) -> None:
    """Find the markers of a frame: dictionary, marker and corner → the frame and where in it the corner is."""
    try:
        image = read_image(frame.path)
    except InputError:
        return  # whoever needs the picture will say so
    grey = image.reshape(*image.shape[:2], -1)[..., :3].mean(-1)
    grey = np.sqrt(np.clip(grey / max(float(np.quantile(grey, 0.99)), 1e-9), 0.0, 1.0))
    scale = min(1.0, _WIDTH / max(grey.shape))
    small = cv2.resize((255 * grey).astype(np.uint8), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    for name in _DICTIONARIES:
        found, ids, _ = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(name)).detectMarkers(small)
        for corners, marker in zip(found, [] if ids is None else np.ravel(ids), strict=True):
            for k, corner in enumerate(corners[0]):
                # OpenCV resizes about the pictures' corners: pixel centres are at +0.5
                sightings[name, int(marker), k].append((frame, (corner.astype(np.float64) + 0.5) / scale - 0.5))


def _triangulated(seen: list[Sighting]) -> np.ndarray | None:
    """The point nearest to all rays (least squares), (3,); None where too few views see it or they do not agree."""
    if len(seen) < _VIEWS:
        return None
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for frame, pixel in seen:
        direction, valid = unproject(pixel, frame.camera)
        if not valid:
            return None
        ray = frame.camera_to_world[:3, :3] @ direction
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        right += across @ frame.camera_to_world[:3, 3]
    if np.linalg.eigvalsh(normal)[0] < 1e-4 * len(seen):
        return None  # rays almost parallel
    point = np.linalg.solve(normal, right)
    for frame, pixel in seen:
        local = frame.camera_to_world[:3, :3].T @ (point - frame.camera_to_world[:3, 3])
        apart = np.linalg.norm(project(local, frame.camera) - pixel) * min(1.0, _WIDTH / max(frame.camera.width, frame.camera.height))
        if not apart <= _APART:  # NaN, too: behind a camera
            return None
    return point
