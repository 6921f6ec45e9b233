"""ArUco markers in pictures, by OpenCV: of a dictionary's thousand markers only those that may be there.

OpenCV compares each quadrilateral of a picture with each marker of the dictionary, 3 ms for one of a thousand (5.0). Here the bits of all
are compared first, at once and with some of them wrong, and OpenCV decides among the few markers that are left.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import cv2
import numpy as np

Found = list[tuple[int, np.ndarray]]
"""Id and corners (4, 2) px of each marker."""

_CELL = 4  # pixels of a bit along each axis, as OpenCV's
_WRONG = 0.1  # of the bits may be, beyond what OpenCV mends: it reads them of a quadrilateral that is off by less than a pixel


def detect_markers(picture: np.ndarray, dictionaries: Sequence[int]) -> list[Found]:
    """Markers of each dictionary in a picture (H, W) uint8, as ``cv2.aruco.ArucoDetector.detectMarkers`` finds them by default."""
    quadrilaterals = _quadrilaterals(picture)
    return [_detect(picture, quadrilaterals, dictionary) for dictionary in dictionaries]


def _detect(picture: np.ndarray, quadrilaterals: np.ndarray, dictionary: int) -> Found:
    whole, likely = cv2.aruco.getPredefinedDictionary(dictionary), _likely(picture, quadrilaterals, dictionary)
    if not len(likely):
        return []
    few = cv2.aruco.Dictionary(whole.bytesList[likely], whole.markerSize, whole.maxCorrectionBits)
    corners, numbers, _ = cv2.aruco.ArucoDetector(few).detectMarkers(picture)
    ids = [] if numbers is None else likely[np.ravel(numbers)].tolist()
    return [(marker, np.reshape(four, (4, 2)).astype(np.float64)) for marker, four in zip(ids, corners, strict=True)]


def _quadrilaterals(picture: np.ndarray) -> np.ndarray:
    """All that might be a marker's outline, (Q, 4, 2) px: all, too, of several about one place, of which OpenCV tries the best first."""
    every = cv2.aruco.DetectorParameters()
    every.minMarkerDistanceRate = every.minGroupDistance = 0.0
    one = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    one.bytesList = one.bytesList[:1]
    met, _, others = cv2.aruco.ArucoDetector(one, every).detectMarkers(picture)
    return np.array([*met, *others], np.float32).reshape(-1, 4, 2)


def _likely(picture: np.ndarray, quadrilaterals: np.ndarray, dictionary: int) -> np.ndarray:
    """Ids of the markers that some quadrilateral may be, rising."""
    whole = cv2.aruco.getPredefinedDictionary(dictionary)
    size, side = whole.markerSize, (whole.markerSize + 2) * _CELL
    square = np.array([[0, 0], [side - 1, 0], [side - 1, side - 1], [0, side - 1]], np.float32)
    light = np.zeros((len(quadrilaterals), side, side), np.uint8)
    for four, out in zip(quadrilaterals, light, strict=True):
        flat = cv2.warpPerspective(picture, cv2.getPerspectiveTransform(four, square), (side, side), flags=cv2.INTER_NEAREST)
        out[:] = cv2.threshold(flat, 0, 1, cv2.THRESH_BINARY | cv2.THRESH_OTSU)[1]
    cells = light.reshape(-1, size + 2, _CELL, size + 2, _CELL).sum((2, 4), dtype=np.int32) > _CELL * _CELL // 2
    inside = cells[:, 1:-1, 1:-1]
    dark_border = cells.sum((1, 2)) - inside.sum((1, 2)) <= 0.5 * 4 * (size + 1)  # OpenCV: 0.35
    read = np.concatenate([np.rot90(inside[dark_border], turn, (1, 2)).reshape(-1, size * size) for turn in range(4)])
    wrong = 0.5 * (size * size - np.where(read, np.float32(1.0), np.float32(-1.0)) @ _codes(dictionary).T)
    return np.flatnonzero((wrong <= 0.6 * whole.maxCorrectionBits + _WRONG * size * size).any(0))


@functools.cache
def _codes(dictionary: int) -> np.ndarray:
    """(N, B) float32: -1 for each black bit of each marker, 1 for each white one."""
    whole = cv2.aruco.getPredefinedDictionary(dictionary)
    bits = [cv2.aruco.Dictionary.getBitsFromByteList(code[None], whole.markerSize).ravel() for code in whole.bytesList]
    return 2.0 * np.array(bits, np.float32) - 1.0
