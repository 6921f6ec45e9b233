"""Markers of a dictionary's thousand: those that OpenCV finds when it compares with all."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mmsynth.scene.capture.aruco import detect_markers

DICTIONARIES = {name: getattr(cv2.aruco, f"DICT_{name}") for name in ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "ARUCO_ORIGINAL")}


def _board(dictionary: int, seed: int) -> tuple[np.ndarray, set[int]]:
    """A board of 17 markers somewhere in a picture, blurred and noisy, and its markers."""
    random = np.random.default_rng(seed)
    markers = cv2.aruco.getPredefinedDictionary(dictionary)
    ids = random.permutation(len(markers.bytesList))[:17].astype(np.int32)
    drawn = cv2.aruco.CharucoBoard((7, 5), 0.1, random.choice([0.05, 0.06, 0.075]), markers, ids).generateImage((420, 300))
    angle, size = random.uniform(0, 2 * np.pi), random.uniform(0.7, 1.2) * np.array([210, 150])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size * (1 + 0.2 * random.normal(size=(4, 2)))) @ turn.T + (320, 240)
    place = cv2.getPerspectiveTransform(np.array([[0, 0], [420, 0], [420, 300], [0, 300]], np.float32), corners.astype(np.float32))
    picture = np.full((480, 640), 0.3, np.float32)
    light = 0.1 + 0.7 * drawn.astype(np.float32) / 255
    cv2.warpPerspective(light, place, (640, 480), dst=picture, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_TRANSPARENT)
    picture = cv2.GaussianBlur(picture, (0, 0), random.uniform(0.3, 1.5)) + random.uniform(0, 0.04) * random.normal(size=picture.shape)
    return (255 * picture.clip(0, 1)).astype(np.uint8), set(ids.tolist())


@pytest.mark.parametrize("name", DICTIONARIES)
def test_as_if_all_were_compared(name: str) -> None:
    met = 0
    for seed in range(3):
        picture, there = _board(DICTIONARIES[name], seed)
        (found,) = detect_markers(picture, [DICTIONARIES[name]])
        corners, ids, _ = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[name])).detectMarkers(picture)
        assert [marker for marker, _ in found] == ([] if ids is None else np.ravel(ids).tolist())
        for (_, ours), theirs in zip(found, corners, strict=True):
            np.testing.assert_array_equal(ours, theirs.reshape(4, 2))
        met += len({marker for marker, _ in found} & there)
    assert met >= 17


def test_each_dictionary_finds_its_own_and_a_blank_picture_has_none() -> None:
    picture, _ = _board(DICTIONARIES["6X6_1000"], 0)
    four, six = detect_markers(picture, [DICTIONARIES["4X4_1000"], DICTIONARIES["6X6_1000"]])
    assert six and not four
    assert detect_markers(np.full((60, 80), 90, np.uint8), list(DICTIONARIES.values())) == [[]] * len(DICTIONARIES)
