"""Calibration boards in a scene whose poses are known. Objects usually stand on or between them: they show the region of interest."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.capture.aruco import detect_markers
from mmsynth.scene.capture.triangulation import Sighting, nearest_point, reprojection_error
from mmsynth.scene.images import read_image
from mmsynth.scene.scene import Frame

_DICTIONARIES = (cv2.aruco.DICT_4X4_1000, cv2.aruco.DICT_5X5_1000, cv2.aruco.DICT_6X6_1000, cv2.aruco.DICT_7X7_1000)
_LOOK, _MOST = 4, 16  # frames that are looked at before the search is given up, and at the most
_WIDTH = 1000  # pixels: larger pictures are made smaller
_VIEWS = 3  # that must agree on a corner
_APART = 2.0  # pixels (of the smaller picture) by which they may disagree

Corner = tuple[int, int, int]  # dictionary, marker, which of its four corners


def board_points(frames: Sequence[Frame]) -> np.ndarray:
    """Corners of ArUco markers (those of ChArUco boards, too), triangulated: (N, 3) in the poses' frame; N = 0 where there are none.

    Args:
        frames: of a sensor without a mosaic. Up to 16 of them are searched, evenly spread, and no more when 4 show no marker.
    """
    return np.array(list(board_corners(frames, _grey).values()), dtype=np.float64).reshape(-1, 3)


def board_corners(frames: Sequence[Frame], picture: Callable[[Frame], np.ndarray | None]) -> dict[Corner, np.ndarray]:
    """As ``board_points``, by corner: (3,) each.

    A corner counts where at least three views see it and it projects to within two pixels of where they do: chance finds do not.

    Args:
        picture: a frame's pixels as (H, W), linear; None where there are none.
    """
    order = np.linspace(0, len(frames) - 1, min(_MOST, len(frames))).round().astype(int)
    spread = np.linspace(0, len(order) - 1, min(_LOOK, len(order))).round().astype(int)
    sightings: dict[Corner, list[Sighting]] = defaultdict(list)

    def look(frame: Frame) -> None:
        grey = picture(frame)
        for corner, pixel in ({} if grey is None else markers_in(grey)).items():
            sightings[corner].append((frame, pixel))

    for i in order[spread]:
        look(frames[i])
    if not sightings:
        return {}
    for i in np.delete(order, spread):
        look(frames[i])
    return {corner: point for corner, seen in sightings.items() if (point := _triangulated(seen)) is not None}


def _grey(frame: Frame) -> np.ndarray | None:
    try:
        image = read_image(frame.path)
    except InputError:
        return None  # whoever needs the picture will say so
    return np.asarray(image.reshape(*image.shape[:2], -1)[..., :3].mean(-1))


def markers_in(grey: np.ndarray) -> dict[Corner, np.ndarray]:
    """Corners of ArUco markers in a linear picture (H, W): (2,) px each; of a marker that is there twice, neither."""
    level = np.sqrt(np.clip(grey / max(float(np.quantile(grey, 0.99)), 1e-9), 0.0, 1.0))
    scale = min(1.0, _WIDTH / max(grey.shape))
    small = cv2.resize((255 * level).astype(np.uint8), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    out: dict[Corner, np.ndarray] = {}
    twice: set[Corner] = set()
    for name, found in zip(_DICTIONARIES, detect_markers(small, _DICTIONARIES), strict=True):
        for marker, corners in found:
            for k, place in enumerate(corners):
                corner = (name, marker, k)
                twice |= {corner} & out.keys()
                # OpenCV resizes about the pictures' corners: pixel centres are at +0.5
                out[corner] = (place + 0.5) / scale - 0.5
    return {corner: place for corner, place in out.items() if corner not in twice}


def _triangulated(seen: list[Sighting]) -> np.ndarray | None:
    """The point nearest to all rays (least squares), (3,); None where too few views see it or they do not agree."""
    if len(seen) < _VIEWS:
        return None
    point = nearest_point(seen)
    if point is None:
        return None
    for frame, pixel in seen:
        scale = min(1.0, _WIDTH / max(frame.camera.width, frame.camera.height))
        if not reprojection_error(point, frame, pixel) * scale <= _APART:  # NaN, too: behind a camera
            return None
    return point
