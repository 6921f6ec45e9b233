"""Previews: recognisable for any sensor, defined for any value."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic import MONO, MS, POL, RGB

from mmsynth.operations.output import previews
from mmsynth.scene.scene import Sensor


@pytest.mark.parametrize(("peak", "brightest"), [(653.0, 0), (541.0, 1), (464.0, 2)])
def test_wavelengths_have_their_colour(peak: float, brightest: int) -> None:
    waves = np.array([np.inf if w is None else w for w in MS.wavelengths_nm])
    light = np.exp(-(((waves - peak) / 30) ** 2)) * np.ones((4, 4, 1))
    assert previews.preview_rgb(MS, light)[0, 0].argmax() == brightest


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9])
@pytest.mark.parametrize("waves", [None, 900.0])
def test_any_sensor(count: int, waves: float | None) -> None:
    sensor = Sensor("other", tuple(map(str, range(count))), tuple(None if waves is None else waves + i for i in range(count)))
    weights = previews.preview_weights(sensor)
    assert weights.shape == (3, count) and np.allclose(weights.sum(1), 1)
    out = previews.preview_rgb(sensor, np.random.default_rng(0).random((5, 6, count)))
    assert out.shape == (5, 6, 3) and out.dtype == np.uint8


def test_polarization_preview_is_s0() -> None:
    channels = np.array([0.3, 0.2, 0.1, 0.2]) * np.ones((2, 2, 1))
    assert np.allclose(previews.preview_linear(POL, channels), 0.4)


@pytest.mark.parametrize("fill", [0.0, 7.0, np.nan])
def test_flat_images(fill: float) -> None:
    assert previews.preview_rgb(RGB, np.full((3, 4, 3), fill)).shape == (3, 4, 3)
    assert previews.preview_rgb(MONO, np.full((3, 4, 1), fill)).shape == (3, 4, 3)
    assert previews.preview_depth(np.full((3, 4), fill)).shape == (3, 4, 3)
    assert previews.preview_normal(np.full((3, 4, 3), fill)).shape == (3, 4, 3)
    assert np.isfinite(previews.preview_aolp(np.full((3, 4, 3), fill))).all()


def test_shared_exposure_keeps_the_ratio() -> None:
    image = np.linspace(0, 1, 30).reshape(5, 6, 1) * np.ones(3)
    exposure = previews.exposure_of(image)
    assert previews.tone_map(0.5 * image, exposure).mean() < previews.tone_map(image, exposure).mean()


@pytest.mark.parametrize(("angle", "colour"), [(0, (1, 0, 0)), (60, (0, 1, 0)), (120, (0, 0, 1)), (180, (1, 0, 0)), (-60, (0, 0, 1))])
def test_aolp_colours(angle: float, colour: tuple[int, int, int]) -> None:
    turn = np.radians(2 * angle)
    stokes = np.array([1.0, 0.5 * np.cos(turn), 0.5 * np.sin(turn)]).reshape(1, 1, 3)
    assert previews.preview_aolp(stokes)[0, 0] == pytest.approx(0.5 * np.array(colour), abs=1e-5)


@pytest.mark.parametrize(("shape", "reduced"), [((1848, 2464), (600, 800)), ((900, 30, 3), (800, 27, 3)), ((700, 800, 3), (700, 800, 3))])
def test_previews_of_large_pictures_are_small(shape: tuple[int, ...], reduced: tuple[int, ...]) -> None:
    across = np.linspace(0.0, 1.0, shape[1], dtype=np.float32)
    found = previews.reduced(np.ones(shape, np.float32) * (across if len(shape) == 2 else across[:, None]))
    assert found.shape == reduced
    # means over areas
    assert abs(float(found.mean()) - 0.5) < 1e-3 and 0.0 <= found.min() < 0.03


def test_contact_sheet(tmp_path: Path) -> None:
    rows = [[np.zeros((10, 20, 3), np.uint8), np.ones((30, 10))], [np.ones((5, 5, 3))]]
    previews.contact_sheet(rows, [["a", "b"], ["c"]], tmp_path / "sheet.png", height=50)
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape[0] == 2 * (50 + 22 + 6) and (sheet == 0).any()
