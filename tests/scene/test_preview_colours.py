"""Colours of previews by the markers of a board and by a colour chart, of pictures whose light is known."""

from __future__ import annotations

from pathlib import Path

import colour
import cv2
import numpy as np
import pytest
from colour.adaptation import chromatic_adaptation_VonKries

from mmsynth.operations.output.previews import preview_linear
from mmsynth.scene.colour_chart import PATCHES, ChartColours, chart_colours
from mmsynth.scene.image_writers import write_png
from mmsynth.scene.images import load_frame
from mmsynth.scene.lattice import find_lattices, to_pixels
from mmsynth.scene.preview_colours import preview_colours_of
from mmsynth.scene.scene import Frame, Sensor
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.mosaic import channel_map

LIGHT = np.array([0.35, 0.8, 0.5])  # of red, green, blue on white
RAW = Sensor("rgb", ("R", "G", "B"), (None,) * 3, np.array([[1, 2], [0, 1]]))
PLAIN = Sensor("rgb", ("R", "G", "B"), (None,) * 3)


def charuco() -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    return cv2.aruco.CharucoBoard((5, 4), 0.04, 0.03, dictionary).generateImage((500, 400), marginSize=20) / 255.0


def chessboard() -> np.ndarray:
    return np.pad(np.kron(np.indices((7, 9)).sum(0) % 2, np.ones((50, 50))), ((25, 25), (25, 25)), constant_values=1.0)


def frames_of(folder: Path, sensor: Sensor, board: np.ndarray | None, gamma: float = 1.0) -> list[Frame]:
    """Two pictures of a grey board on a coloured floor, with shot noise, in 16 bits of a 12-bit converter, or encoded in 8."""
    random = np.random.default_rng(0)
    out = []
    for view in range(2):
        albedo = np.tile([0.2, 0.1, 0.4], (480, 640, 1))
        if board is not None:
            albedo[40:440, 60 + 20 * view : 560 + 20 * view] = (0.05 + 0.9 * board)[..., None]
        light = (random.poisson(4000 * albedo * LIGHT) / 4000).clip(0, 1) ** (1 / gamma)
        numbers = np.round(4095 * light).astype(np.uint16) << 4 if gamma == 1 else np.round(255 * light).astype(np.uint8)
        if sensor.mosaic is not None:
            numbers = np.take_along_axis(numbers, channel_map(sensor.mosaic, 480, 640)[..., None], -1)[..., 0]
        write_png(folder / f"{view}.png", numbers)
        out.append(Frame("rgb", view, folder / f"{view}.png", Camera(640, 480, 600.0, 600.0, 320.0, 240.0), np.eye(4)))
    return out


@pytest.mark.parametrize("board", [charuco(), chessboard()], ids=["charuco", "chessboard"])
@pytest.mark.parametrize("sensor", [RAW, PLAIN], ids=["mosaic", "plain"])
def test_a_board_becomes_grey_and_data_stay_as_they_are(tmp_path: Path, sensor: Sensor, board: np.ndarray) -> None:
    frames = frames_of(tmp_path, sensor, board)
    before = [frame.path.read_bytes() for frame in frames]
    loaded = load_frame(sensor, frames[0])[0].copy()
    found = preview_colours_of(sensor, frames)
    assert found is not None and found.seen == "board" and found.count >= 12 and found.spread < 0.02
    np.testing.assert_allclose(found.matrix, np.diag(LIGHT[1] / LIGHT), rtol=0.01)
    assert [frame.path.read_bytes() for frame in frames] == before
    np.testing.assert_array_equal(load_frame(sensor, frames[0])[0], loaded)
    white = preview_linear(PLAIN, np.broadcast_to(LIGHT, (4, 4, 3)), found)
    np.testing.assert_allclose(white, 0.8, rtol=0.01)


def test_without_a_board_or_linear_values_there_is_none(tmp_path: Path) -> None:
    assert preview_colours_of(PLAIN, frames_of(tmp_path, PLAIN, None)) is None
    assert preview_colours_of(PLAIN, frames_of(tmp_path, PLAIN, charuco(), gamma=2.2)) is None
    frames = frames_of(tmp_path, PLAIN, charuco())
    assert preview_colours_of(Sensor("ms", ("a", "b", "c"), (None,) * 3), frames) is None
    assert preview_colours_of(PLAIN, []) is None
    frames[0].path.write_bytes(b"")
    assert preview_colours_of(PLAIN, frames) is None


SENSITIVITY = np.array([[0.55, 0.10, 0.02], [0.18, 0.70, 0.12], [0.02, 0.15, 0.45]])  # linear sRGB → what the sensor measures


def chart_picture(light: np.ndarray, turned: bool = False) -> np.ndarray:
    """(560, 760, 3) linear: a chart seen at an angle before grey, through a sensor with filters of its own."""
    patch, gap, rim = 60, 9, 14
    chart = np.full((4 * patch + 3 * gap + 2 * rim, 6 * patch + 5 * gap + 2 * rim, 3), 0.006)
    for index, patch_colour in enumerate(PATCHES.clip(0)):
        row, column = divmod(index, 6)
        top, left = rim + row * (patch + gap), rim + column * (patch + gap)
        chart[top : top + patch, left : left + patch] = patch_colour
    chart = chart[::-1, ::-1] if turned else chart
    height, width = chart.shape[:2]
    corners = np.array([(150, 100), (640, 140), (600, 454), (120, 429)], np.float32)
    to_picture = cv2.getPerspectiveTransform(np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32), corners)
    warped = cv2.warpPerspective(chart, to_picture, (760, 560), flags=cv2.INTER_AREA)
    inside = cv2.warpPerspective(np.ones((height, width)), to_picture, (760, 560))[..., None]
    return (warped * inside + 0.12 * (1 - inside)) @ SENSITIVITY.T * light


def chart_in(picture: np.ndarray) -> ChartColours | None:
    return chart_colours(picture, find_lattices(picture))


@pytest.mark.parametrize("turned", [False, True])
def test_a_chart_gives_the_colours(turned: bool) -> None:
    random = np.random.default_rng(0)
    picture = chart_picture(np.array([0.5, 0.9, 0.6]), turned)
    found = chart_in(random.poisson(8000 * picture) / 8000)
    assert found is not None and found.spread < 0.05
    true = np.linalg.inv(SENSITIVITY) / np.array([0.5, 0.9, 0.6])
    np.testing.assert_allclose(found.matrix / found.matrix.sum(), true / true.sum(), atol=0.02)


def test_a_chart_of_other_colours_is_none() -> None:
    random = np.random.default_rng(0)
    assert chart_in(chart_picture(np.array([0.5, 0.9, 0.6])) ** 3) is None  # not linear
    assert chart_in(random.uniform(0, 1, (200, 300, 3))) is None
    assert chart_in(np.zeros((200, 300, 3))) is None


def test_info_finds_the_chart_of_a_mosaic(tmp_path: Path) -> None:
    picture = cv2.resize(chart_picture(np.array([0.5, 0.9, 0.6])), None, fx=2.5, fy=2.5, interpolation=cv2.INTER_LINEAR)
    picture = (np.random.default_rng(0).poisson(8000 * picture) / 8000).clip(0, 1)
    numbers = np.round(4095 * picture).astype(np.uint16) << 4
    mosaic = np.take_along_axis(numbers, channel_map(RAW.mosaic, *numbers.shape[:2])[..., None], -1)[..., 0]  # type: ignore[arg-type]
    write_png(tmp_path / "0.png", mosaic)
    frame = Frame("rgb", 0, tmp_path / "0.png", Camera(mosaic.shape[1], mosaic.shape[0], 600.0, 600.0, 320.0, 240.0), np.eye(4))
    found = preview_colours_of(RAW, [frame])
    assert found is not None and found.seen == "chart" and found.count == 1
    skin = PATCHES.clip(0)[0]
    shown = preview_linear(PLAIN, (skin @ SENSITIVITY.T * [0.5, 0.9, 0.6])[None, None], found)[0, 0]
    np.testing.assert_allclose(shown / shown.mean(), skin / skin.mean(), rtol=0.05)


def test_the_published_colours_are_those_of_colour_science() -> None:
    chart = colour.CCS_COLOURCHECKERS["ColorChecker24 - After November 2014"]
    d65 = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    xyz = colour.xyY_to_XYZ(np.array(list(chart.data.values())))
    adapted = chromatic_adaptation_VonKries(xyz, colour.xy_to_XYZ(chart.illuminant), colour.xy_to_XYZ(d65), transform="Bradford")
    np.testing.assert_allclose(PATCHES, adapted @ colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T, atol=6e-4)


@pytest.mark.parametrize("seed", range(6))
def test_charts_and_boards_lie_as_they_were_drawn(seed: int) -> None:
    """A lattice of squares through a random homography, before squares of random colours: its middles are found to half a pixel."""
    random = np.random.default_rng(seed)
    columns, rows = random.integers(4, 8, 2)
    drawn = np.full((60 * rows + 10, 60 * columns + 10, 3), 0.01)
    for i, j in np.ndindex(rows, columns):
        drawn[60 * i + 10 : 60 * i + 60, 60 * j + 10 : 60 * j + 60] = random.uniform(0.05, 1, 3)
    height, width = drawn.shape[:2]
    outline = np.array([(0, 0), (width, 0), (width, height), (0, height)], np.float32)
    where = (outline / max(width, height) * 380 + (120, 60) + random.uniform(-30, 30, (4, 2))).astype(np.float32)
    homography = cv2.getPerspectiveTransform(outline, where)
    picture = cv2.warpPerspective(drawn, homography, (640, 480), flags=cv2.INTER_AREA, borderValue=(0.2, 0.3, 0.2))
    best = find_lattices(picture)[0]
    assert len(best.cells) >= 0.8 * rows * columns
    middles = np.array([(60 * j + 34.5, 60 * i + 34.5) for i, j in np.ndindex(rows, columns)], np.float32)
    true = cv2.perspectiveTransform(middles[None], homography)[0]
    places, _ = to_pixels(best.to_pixels, best.cells)
    away = np.linalg.norm(places[:, None] - true, axis=-1).min(1)
    assert np.median(away) < 0.5
    again = find_lattices(picture)[0]
    np.testing.assert_array_equal(again.to_pixels, best.to_pixels)
