"""Pictures and numbers of a page keep to their budgets, and say what their colours stand for."""

from __future__ import annotations

import base64

import numpy as np
import pytest
from analytic import MS

from mmsynth.report.pictures import NO_RAY, PICTURES, Picture, Row, Wipe, ceiling, encode_rows, error_map, spectra_of, spectra_width


def test_scales_end_at_round_numbers() -> None:
    found = [ceiling(value) for value in (0.01, 0.0101, 0.26, 0.9, 1.0, 13.0)]
    assert found == pytest.approx([0.01, 0.015, 0.3, 1.0, 1.0, 15.0]) and ceiling(0.0) == ceiling(float("nan")) == 1.0


def test_colours_of_a_map_are_those_of_its_scale() -> None:
    image, scale = error_map(np.array([[0.0, 0.2, 0.9, np.nan]]), 0.2)
    assert (scale.low, scale.high) == (0.0, 0.2)
    assert (image[0, 0] == scale.colours[0]).all() and (image[0, 1] == scale.colours[-1]).all() and (image[0, 2] == scale.colours[-1]).all()
    assert (image[0, 3] == 96).all()


def test_pictures_share_the_budget_of_a_page_and_wipes_keep_one_size() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (500, 900, 3), np.uint8)
    flat = np.zeros_like(noise)
    rows = [Row(str(i), [Wipe(Picture("a", noise, "a"), Picture("b", flat, "b")), Picture("c", noise, "c")]) for i in range(20)]
    shown = [p for row in encode_rows(rows) for p in row["pictures"]]
    assert sum(len(one["source"]) for p in shown for one in ((p["over"], p["under"]) if "over" in p else (p,))) <= PICTURES
    for p in shown:
        if "over" in p:
            assert (p["over"]["width"], p["over"]["height"]) == (p["under"]["width"], p["under"]["height"])
            assert p["over"]["width"] / p["over"]["height"] == pytest.approx(1.8, abs=0.02)
    small = Picture("d", noise[:40, :60], "d").encode(1e6)
    assert (small["width"], small["height"]) == (60, 40) and small["source"].startswith("data:image/png")


def test_light_is_told_for_blocks_of_pixels_as_their_mean() -> None:
    light = np.random.default_rng(1).random((40, 60, 9)).astype(np.float32) - 0.45
    light[:4, :4] = np.nan
    light[8, 8] = np.nan
    stored = spectra_of(MS, 15, rendered=light)
    assert (stored["width"], stored["height"], stored["cell"]) == (15, 10, [4.0, 4.0]) and stored["low"] < 0.0
    steps = np.frombuffer(base64.b64decode(stored["rendered"]), "<u2").reshape(10, 15, 9)
    assert (steps[0, 0] == NO_RAY).all() and (steps.reshape(-1, 9)[1:] < NO_RAY).all()
    values = stored["low"] + steps / (NO_RAY - 1) * (stored["high"] - stored["low"])
    blocks = light.reshape(10, 4, 15, 4, 9).swapaxes(1, 2).reshape(150, 16, 9)
    np.testing.assert_allclose(values.reshape(-1, 9)[1:], np.nanmean(blocks[1:], 1), atol=2e-5)


def test_many_channels_are_told_at_fewer_pixels() -> None:
    assert spectra_width(640, 480, 36) == 96 and spectra_width(60, 40, 36) == 60
    width = spectra_width(4000, 3000, 2 * 200)
    assert 8 < width < 96 and width * width * 3 / 4 * 400 * 2 * 4 / 3 < 1_700_000
