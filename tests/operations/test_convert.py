"""Sensor to sensor: on the source's pixels, at its pose, complete files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from analytic import AnalyticField, scene_of, sphere

from mmsynth.errors import InputError
from mmsynth.operations.convert import convert
from mmsynth.scene.images import read_image
from mmsynth.sensors.polarization import stokes_to_intensities


def test_convert_to_multispectral(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", views=3, truth=False)
    calls: list[tuple[int, int]] = []
    written = convert(field, scene, "rgb", "multispectral", tmp_path / "out", method="field", progress=lambda *c: calls.append(c))  # type: ignore[arg-type]
    assert sorted(p.name for p in written) == [f"{v:04d}{s}" for v in range(3) for s in (".json", ".npz", ".png", "_confidence.png")]
    assert all(p.parent == tmp_path / "out" / "ms" and p.is_file() for p in written)
    frame = scene.frames_of("rgb")[1]
    with np.load(tmp_path / "out/ms/0001.npz") as arrays:
        truth = field.render(frame.camera, frame.camera_to_world, ["ms"])
        assert np.array_equal(arrays["data"], truth.channels["ms"], equal_nan=True)
        assert arrays["channels"].tolist() == list(field.sensors["ms"].channels)
        assert arrays["wavelengths_nm"][0] == 692 and np.isnan(arrays["wavelengths_nm"][8])
        assert np.array_equal(arrays["opacity"], truth.opacity)
    sidecar = json.loads((tmp_path / "out/ms/0001.json").read_text())
    assert sidecar["camera"]["distortion"] == list(frame.camera.distortion)
    assert sidecar["camera"]["camera_to_world"] == frame.camera_to_world.tolist()
    assert sidecar["from"] == "rgb" and sidecar["unit"] == "m"
    picture = cv2.imread(str(tmp_path / "out/ms/0001.png"), cv2.IMREAD_UNCHANGED)
    assert picture.dtype == np.uint16 and picture.shape == (18, 24, 3)
    assert calls[-1][0] == calls[-1][1] and calls == sorted(calls)


def test_convert_to_polarization(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", views=2, truth=False)
    written = convert(field, scene, "multispectral", "pol", tmp_path / "out", views=[1])  # type: ignore[arg-type]
    assert sorted(p.name for p in written) == ["0001.json", "0001.npz", "0001.png", "0001_aolp.png", "0001_confidence.png", "0001_dolp.png"]
    with np.load(tmp_path / "out/pol/0001.npz") as arrays:
        assert np.allclose(stokes_to_intensities(torch.from_numpy(arrays["stokes"]), (0, 45, 90, 135)), arrays["data"], atol=1e-6)
        seen = arrays["opacity"] > 0.5
    assert read_image(tmp_path / "out/pol/0001_dolp.png")[seen] == pytest.approx(0.3, abs=1e-4)


def test_rerun_gives_the_same_bytes(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", views=1, truth=False)
    first = {p: p.read_bytes() for p in convert(field, scene, "rgb", "pol", tmp_path / "out")}  # type: ignore[arg-type]
    again = {p: p.read_bytes() for p in convert(field, scene, "rgb", "pol", tmp_path / "out")}  # type: ignore[arg-type]
    assert first == again


@pytest.mark.parametrize(
    ("source", "target", "views", "message"),
    [
        ("rgb", "thermal", None, "'thermal': not in this field, expected one of rgb, ms, pol, mono"),
        ("thermal", "rgb", None, "'thermal': not in the scene .* expected one of rgb, ms, pol, mono"),
        ("rgb", "ms", [0, 9], "view 9: .* expected some of 0-1"),
        ("rgb", "ms", [], "no views"),
    ],
)
def test_refuses(tmp_path: Path, source: str, target: str, views: list[int] | None, message: str) -> None:
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", views=2, truth=False)
    with pytest.raises(InputError, match=message):
        convert(field, scene, source, target, tmp_path / "out", views)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
