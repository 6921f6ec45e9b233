"""The report is one file that says what was measured, with nothing fetched from anywhere."""

from __future__ import annotations

import json
import re
from pathlib import Path

from analytic import AnalyticField, scene_of, sphere

from mmsynth.operations.evaluate import evaluate
from mmsynth.report.report import curve_svg, read_log, write_report


def test_report(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene")
    field.manifest = {"needs": {"evidence": {"background": "off: <nothing> there"}, "footprint": 0.01}, "seed": 7, "seconds": {"fit": 60.5}}
    log = [{"step": i, "elapsed": 1.0 * i, "loss": 1 / (i + 1), "psnr": {"rgb": 20.0 + i}} for i in range(5)]
    evaluation = evaluate(field, scene)  # type: ignore[arg-type]
    page = write_report(tmp_path, field, evaluation, log, scene).read_text()  # type: ignore[arg-type]
    assert page.count("data:image/png;base64,") == 3 * 4 + 2 + 3  # frame, rendering, difference; polarization; geometry
    assert (tmp_path / "preview.png").is_file()
    assert "&lt;nothing&gt;" in page and "<nothing>" not in page
    for text in ("PSNR [dB]", "spectral angle", "depth error", "60.5", "<svg", "Test views: 3."):
        assert text in page
    assert not re.search(r"<script|(?:src|href)=.https?:", page)


def test_report_of_a_bare_run(tmp_path: Path) -> None:
    """No scene, no scores, no log: still a page."""
    page = write_report(tmp_path, AnalyticField(sphere())).read_text()  # type: ignore[arg-type]
    assert "<h1>" in page and "<svg" not in page


def test_log(tmp_path: Path) -> None:
    path = tmp_path / "train.jsonl"
    assert read_log(path) == [] and curve_svg([]) == ""
    path.write_text(json.dumps({"step": 1, "elapsed": 1.0, "loss": 0.5, "psnr": {"rgb": 20}}) + '\n{"step": 2, "el')
    assert len(read_log(path)) == 1
    assert "<svg" in curve_svg([{"step": 1, "loss": None, "psnr": {}}])
