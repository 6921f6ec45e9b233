"""Scores of conversions: a perfect field scores perfectly, a wrong one is mended by the frame, baselines are what they say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic import AnalyticField, WrongField, scene_of, sphere

from mmsynth.errors import InputError
from mmsynth.operations.evaluation.conversions import evaluate_conversion
from mmsynth.sensors.camera import Camera


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    field: Any = AnalyticField(sphere())
    field.cameras = dict.fromkeys(field.cameras, Camera(48, 36, 52.0, 52.0, 23.1, 17.6, (-0.1, 0.05, 0.001, -0.002)))
    return scene_of(field, tmp_path_factory.mktemp("conversion"), views=4)


def _field(kind: Any) -> Any:
    return kind(sphere())


@pytest.mark.parametrize(("source", "target", "truth"), [("rgb", "ms", "aligned"), ("mono", "rgb", "own pose"), ("rgb", "pol", "aligned")])
def test_a_perfect_field_needs_no_frame(scene: Any, source: str, target: str, truth: str) -> None:
    found = evaluate_conversion(_field(AnalyticField), scene, source, target)
    assert found["truth"] == truth and found["views"] == [3] and sum(found["auto"].values()) == pytest.approx(1.0)
    assert set(found["methods"]) == {"auto", "field", "ratio", "guided", "linear", "nearest"}
    assert found["methods"]["field"]["psnr"] > 80 and found["methods"]["auto"]["psnr"] > 50
    field = found["methods"]["field"]
    if target == "pol":
        assert field["stokes_rmse"] < 1e-4 and field["dolp_rmse"] < 1e-3 and field["aolp_mae"] < 0.1 and field["physical"] == 1.0
    else:
        assert field["sam"] < 0.1 and field["ergas"] < 0.1 and len(field["rmse"]) == {"ms": 9, "rgb": 3}[target]
    assert field["ssim"] == pytest.approx(1.0, abs=1e-4) and field["psnr_region"] > 80


def test_a_wrong_field_is_mended_and_the_baselines_are_worse(scene: Any) -> None:
    methods = evaluate_conversion(_field(WrongField), scene, "rgb", "ms")["methods"]
    assert methods["auto"]["psnr"] > max(m["psnr"] for m in methods.values()) - 0.1
    assert methods["guided"]["psnr"] > methods["field"]["psnr"] + 8
    assert methods["guided"]["psnr"] > max(methods["linear"]["psnr"], methods["nearest"]["psnr"])
    # its colours are in proportion, so a linear map of the frame is all that is needed, too, but for the demosaicking
    assert methods["linear"]["psnr"] > methods["field"]["psnr"]


def test_raw_frames_will_do(tmp_path: Path) -> None:
    field: Any = _field(WrongField)
    scene = scene_of(field, tmp_path / "scene", views=3, truth=False)
    found = evaluate_conversion(field, scene, "rgb", "mono", views=[2])
    assert found["truth"] == "raw" and set(found["methods"]["field"]) == {"psnr"}
    assert all(np.isfinite(m["psnr"]) for m in found["methods"].values())


def test_what_cannot_be_judged_is_refused(scene: Any) -> None:
    field = _field(AnalyticField)
    with pytest.raises(InputError, match="'thermal': not in this field"):
        evaluate_conversion(field, scene, "rgb", "thermal")
    with pytest.raises(InputError, match="no frames of rgb in the test views"):
        evaluate_conversion(field, scene, "rgb", "ms", views=[77])
