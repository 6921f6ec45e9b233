"""White balance by the markers of a board, of pictures whose light is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mmsynth.operations.output.previews import preview_linear
from mmsynth.scene.image_writers import write_png
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, Sensor
from mmsynth.scene.white_balance import white_balance_of
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.mosaic import channel_map

LIGHT = np.array([0.35, 0.8, 0.5])  # of red, green, blue on white
RAW = Sensor("rgb", ("R", "G", "B"), (None,) * 3, np.array([[1, 2], [0, 1]]))
PLAIN = Sensor("rgb", ("R", "G", "B"), (None,) * 3)


def frames_of(folder: Path, sensor: Sensor, board: bool = True, gamma: float = 1.0) -> list[Frame]:
    """Two pictures of a grey board on a coloured floor, with shot noise, in 16 bits of a 12-bit converter, or encoded in 8."""
    random = np.random.default_rng(0)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    drawn = cv2.aruco.CharucoBoard((5, 4), 0.04, 0.03, dictionary).generateImage((500, 400), marginSize=20) / 255.0
    out = []
    for view in range(2):
        albedo = np.tile([0.2, 0.1, 0.4], (480, 640, 1))
        if board:
            albedo[40:440, 60 + 20 * view : 560 + 20 * view] = (0.05 + 0.9 * drawn)[..., None]
        light = (random.poisson(4000 * albedo * LIGHT) / 4000).clip(0, 1) ** (1 / gamma)
        numbers = np.round(4095 * light).astype(np.uint16) << 4 if gamma == 1 else np.round(255 * light).astype(np.uint8)
        if sensor.mosaic is not None:
            numbers = np.take_along_axis(numbers, channel_map(sensor.mosaic, 480, 640)[..., None], -1)[..., 0]
        write_png(folder / f"{view}.png", numbers)
        out.append(Frame("rgb", view, folder / f"{view}.png", Camera(640, 480, 600.0, 600.0, 320.0, 240.0), np.eye(4)))
    return out


@pytest.mark.parametrize("sensor", [RAW, PLAIN], ids=["mosaic", "plain"])
def test_a_board_becomes_grey_and_data_stay_as_they_are(tmp_path: Path, sensor: Sensor) -> None:
    frames = frames_of(tmp_path, sensor)
    before = [frame.path.read_bytes() for frame in frames]
    loaded = load_frame(sensor, frames[0])[0].copy()
    found = white_balance_of(sensor, frames)
    assert found is not None and found.markers >= 12 and found.spread < 0.02
    np.testing.assert_allclose(found.gains, LIGHT[1] / LIGHT, rtol=0.01)
    assert [frame.path.read_bytes() for frame in frames] == before
    np.testing.assert_array_equal(load_frame(sensor, frames[0])[0], loaded)
    white = preview_linear(PLAIN, np.broadcast_to(LIGHT, (4, 4, 3)), found)
    np.testing.assert_allclose(white, 0.8, rtol=0.01)


def test_without_a_board_or_linear_values_there_is_none(tmp_path: Path) -> None:
    assert white_balance_of(PLAIN, frames_of(tmp_path, PLAIN, board=False)) is None
    assert white_balance_of(PLAIN, frames_of(tmp_path, PLAIN, gamma=2.2)) is None
    frames = frames_of(tmp_path, PLAIN)
    assert white_balance_of(Sensor("ms", ("a", "b", "c"), (None,) * 3), frames) is None
    assert white_balance_of(PLAIN, []) is None
    frames[0].path.write_bytes(b"")
    assert white_balance_of(PLAIN, frames) is None
