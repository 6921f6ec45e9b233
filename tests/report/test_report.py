"""The report is one file that says what was measured, with nothing fetched from anywhere."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic import AnalyticField, scene_of, sphere

from mmsynth.operations.evaluation.evaluate import evaluate
from mmsynth.report.report import curve_svg, measured_channels, read_log, write_run_report
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.scene import Frame, Sensor
from mmsynth.sensors.camera import Camera


def test_report(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene")
    field.manifest = {
        "needs": {"choices": {"background": {"value": False, "why": "off: <nothing> there", "changed": False}}, "footprint": 0.01},
        "seed": 7,
        "seconds": {"fit": 60.5},
    }
    log = [{"step": i, "elapsed": 1.0 * i, "loss": 1 / (i + 1), "psnr": {"rgb": 20.0 + i}} for i in range(5)]
    evaluation = evaluate(field, scene)  # type: ignore[arg-type]
    page = write_run_report(tmp_path, field, evaluation=evaluation, train_log=log, scene=scene).read_text()  # type: ignore[arg-type]
    assert page.count("data:image/png;base64,") == 3 * 4 + 2 + 3  # frame, rendering, difference; polarization; geometry
    assert (tmp_path / "preview.png").is_file()
    assert "&lt;nothing&gt;" in page and "<nothing>" not in page
    for text in ("PSNR [dB]", "spectral angle", "depth error", "60.5", "<svg", "Test views: 3."):
        assert text in page
    assert not re.search(r"<script|(?:src|href)=.https?:", page)


def test_report_of_a_bare_run(tmp_path: Path) -> None:
    """No scene, no scores, no log: still a page."""
    page = write_run_report(tmp_path, AnalyticField(sphere())).read_text()  # type: ignore[arg-type]
    assert "<h1>" in page and "<svg" not in page


def test_log(tmp_path: Path) -> None:
    path = tmp_path / "train.jsonl"
    assert read_log(path) == [] and curve_svg([]) == ""
    path.write_text(json.dumps({"step": 1, "elapsed": 1.0, "loss": 0.5, "psnr": {"rgb": 20}}) + '\n{"step": 2, "el')
    assert len(read_log(path)) == 1
    assert "<svg" in curve_svg([{"step": 1, "loss": None, "psnr": {}}])


@pytest.mark.parametrize("pattern", [[[1, 2], [0, 1]], [[2, 1], [1, 0]], [[0, 1], [2, 3]], [[0]]])
def test_previews_of_a_mosaic_show_every_channel_in_its_place(tmp_path: Path, pattern: list[list[int]]) -> None:
    """Each channel has a level of its own; Bayer patterns by OpenCV's edge-aware method, others by normalised convolution."""
    mosaic = np.array(pattern)
    count = int(mosaic.max()) + 1
    levels = (np.arange(count) + 1) / 8
    raw = np.tile(levels[mosaic], (20, 30))[:20, :30]
    raw[6:10, 10:20] = 0.9
    write_png16(tmp_path / "0.png", raw)
    sensor = Sensor("rgb", tuple("RGBW"[:count]), (None,) * count, mosaic)
    shown = measured_channels(sensor, Frame("rgb", 0, tmp_path / "0.png", Camera(30, 20, 20.0, 20.0, 15.0, 10.0), np.eye(4)))
    assert shown.shape == (20, 30, count)
    np.testing.assert_allclose(shown[1:4, 2:8], np.broadcast_to(levels, (3, 6, count)), atol=1e-4)
    if count == 3:
        codes = {(1, 2): cv2.COLOR_BayerGR2RGB_EA, (2, 1): cv2.COLOR_BayerRG2RGB_EA}
        theirs = cv2.demosaicing(np.round(raw * 65535).astype(np.uint16), codes[tuple(pattern[0])]) / 65535
        np.testing.assert_allclose(shown, theirs, atol=1e-5)


def test_previews_of_frames_with_alpha_show_what_is_scored(tmp_path: Path) -> None:
    """Colours behind transparent pixels are of nothing that was seen."""
    rgba = np.random.default_rng(0).random((20, 30, 4)).astype(np.float32)
    rgba[:10, :, 3] = 0.0
    cv2.imwrite(str(tmp_path / "0.png"), np.round(65535 * rgba[..., [2, 1, 0, 3]]).astype(np.uint16))
    frame = Frame("rgb", 0, tmp_path / "0.png", Camera(30, 20, 20.0, 20.0, 15.0, 10.0), np.eye(4))
    shown = measured_channels(Sensor("rgb", ("R", "G", "B"), (None, None, None)), frame)
    np.testing.assert_allclose(shown, rgba[..., :3] * rgba[..., 3:], atol=2e-5)
    assert not shown[:10].any()
