"""ArUco markers of ChArUco boards, and the corners of squares that they lead to."""

from __future__ import annotations

import cv2
import numpy as np

from mmsynth.scene.capture.board import Board, corner_points, marker_points

Markers = dict[int, np.ndarray]
"""(4, 2) px: the corners of each marker, by id."""

_NEAR, _FARTHER = 0.2, 0.15  # squares by which a marker may lie elsewhere than another one leads to, and more for each square between them


def find_markers_in(grey: np.ndarray, dictionary: str) -> Markers:
    """Markers in a picture (H, W) uint8; of one that is there twice, neither."""
    parameters = cv2.aruco.DetectorParameters()
    # small markers have few pixels: wide windows, a wide margin, and quadrilaterals that are not quite straight
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax, parameters.adaptiveThreshWinSizeStep = 5, 75, 10
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.25
    parameters.polygonalApproxAccuracyRate = 0.05
    parameters.minDistanceToBorder = 0
    code = getattr(cv2.aruco, dictionary)
    corners, ids, _ = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(code), parameters).detectMarkers(grey)
    found = [] if ids is None else [int(i) for i in np.ravel(ids)]
    return {i: np.reshape(four, (4, 2)).astype(np.float64) for i, four in zip(found, corners, strict=True) if found.count(i) == 1}


def chart_corners(board: Board, markers: Markers) -> list[tuple[np.ndarray, np.ndarray]]:
    """Where the corners of squares are around the markers of a ChArUco board.

    Returns:
        ids (N,) and pixels (N, 2), to a pixel or two; two such pairs where the markers alone do not tell how OpenCV began the board.
    """
    out = []
    for legacy in (False, True) if board.squares[1] % 2 == 0 else (False,):
        guesses: dict[int, list[np.ndarray]] = {}
        places = marker_points(board, legacy)
        for marker, matrix in _agreeing(board, places, {i: markers[i] for i in places if i in markers}).items():
            points = places[marker]
            around = np.abs(corner_points(board)[:, :2] - points[:, :2].mean(0)).max(1) < 0.6 * board.square
            for i in np.flatnonzero(around):
                x, y, w = matrix @ [*corner_points(board)[i, :2], 1.0]
                if w > 0:
                    guesses.setdefault(int(i), []).append(np.array([x / w, y / w]))
        ids = np.array(sorted(guesses))
        if len(ids) >= 3:
            out.append((ids, np.stack([np.median(guesses[i], axis=0) for i in ids])))
    return out


def _agreeing(board: Board, places: dict[int, np.ndarray], markers: Markers) -> dict[int, np.ndarray]:
    """The largest set of markers that lie to each other as on the board, at least two: one may be misread. (3, 3) board → pixels each."""
    to_pixels = {
        i: cv2.getPerspectiveTransform(places[i][:, :2].astype(np.float32), corners.astype(np.float32)) for i, corners in markers.items()
    }
    best: list[int] = []
    for i, matrix in to_pixels.items():
        agree = [i]
        for j in markers:
            middle = places[j][:, :2].mean(0)
            x, y, w = matrix @ [*middle, 1.0]
            away = float(np.linalg.norm(middle - places[i][:, :2].mean(0))) / board.square
            side = np.sqrt(abs(cv2.contourArea(markers[j].astype(np.float32)))) * board.square / (board.marker or board.square)
            if j != i and w > 0 and np.linalg.norm([x / w, y / w] - markers[j].mean(0)) < (_NEAR + _FARTHER * away) * side:
                agree.append(j)
        best = max(best, agree, key=len)
    return {i: to_pixels[i] for i in best} if len(best) >= 2 else {}
