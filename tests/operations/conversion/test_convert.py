"""Sensor to sensor: on the source's pixels, at its pose, complete files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from analytic import RGB, AnalyticField, ring_pose, scene_of, sphere

from mmsynth.errors import InputError
from mmsynth.operations.conversion.files import convert_files
from mmsynth.operations.output.records import read_record
from mmsynth.operations.views.coverage import coverage, training_rays
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.images import read_image
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.mosaic import mosaic
from mmsynth.sensors.polarization import stokes_to_intensities


def test_convert_to_multispectral(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", views=3, truth=False)
    calls: list[tuple[int, int]] = []
    written = convert_files(
        field, scene, tmp_path / "out", source="rgb", target="multispectral", method="field", progress=lambda *c: calls.append(c)
    )  # type: ignore[arg-type]
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
    written = convert_files(field, scene, tmp_path / "out", source="multispectral", target="pol", frames=[1])  # type: ignore[arg-type]
    assert sorted(p.name for p in written) == ["0001.json", "0001.npz", "0001.png", "0001_aolp.png", "0001_confidence.png", "0001_dolp.png"]
    with np.load(tmp_path / "out/pol/0001.npz") as arrays:
        assert np.allclose(stokes_to_intensities(torch.from_numpy(arrays["stokes"]), (0, 45, 90, 135)), arrays["data"], atol=1e-6)
        seen = arrays["opacity"] > 0.5
    assert read_image(tmp_path / "out/pol/0001_dolp.png")[seen] == pytest.approx(0.3, abs=1e-4)


def test_rerun_gives_the_same_bytes(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", views=1, truth=False)
    first = {p: p.read_bytes() for p in convert_files(field, scene, tmp_path / "out", source="rgb", target="pol")}  # type: ignore[arg-type]
    again = {p: p.read_bytes() for p in convert_files(field, scene, tmp_path / "out", source="rgb", target="pol")}  # type: ignore[arg-type]
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
        convert_files(field, scene, tmp_path / "out", source=source, target=target, frames=views)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("file_format", ["npz", "exr", "tiff"])
def test_at_given_poses(tmp_path: Path, file_format: Any) -> None:
    """The field alone where there is no frame; the frame has its say where there is one, found by its name."""
    field: Any = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", views=3, truth=False)
    camera = field.cameras["rgb"]
    views = [PosedCamera(camera, ring_pose(i, 9), f"images/shot{i}.jpg") for i in range(3)]
    rays = training_rays(field, scene)
    convert_files(field, scene, tmp_path / "plain", source="rgb", target="ms", views=views, file_format=file_format)
    for i in range(3):
        facts = json.loads((tmp_path / f"plain/ms/shot{i}.json").read_text())
        assert facts["method"] == "field" and facts["frame"] is None and facts["guided"] == 0
        back = read_record(tmp_path / "plain/ms", facts["files"], f"shot{i}")
        seen = field.render(camera, ring_pose(i, 9), [])
        covered = coverage(rays, PosedCamera(camera, ring_pose(i, 9)), seen.depth_ray, seen.normal)
        np.testing.assert_allclose(back["confidence"], np.where(np.isnan(covered), 0.0, covered), atol=1e-6)
        assert (np.nanmean(covered) > 0.94) == (i == 0)  # a training pose
        np.testing.assert_allclose(back["data"], field.render(camera, ring_pose(i, 9), ["ms"]).channels["ms"], atol=1 / 65535)
    raw = mosaic(torch.from_numpy(field.render(camera, ring_pose(1, 9), ["rgb"]).channels["rgb"]).movedim(-1, 0), RGB.mosaic)  # type: ignore[arg-type]
    write_png16(tmp_path / "shot1.png", 0.5 * raw.numpy())
    to_ms: Any = {"source": "rgb", "target": "ms", "views": views, "file_format": file_format}
    convert_files(field, scene, tmp_path / "seen", images=[tmp_path / "shot1.png"], as_sensor=True, **to_ms)
    assert [p.stem for p in (tmp_path / "seen/ms").glob("*.json")] == ["shot1"]
    facts = json.loads((tmp_path / "seen/ms/shot1.json").read_text())
    assert facts["method"] == "auto" and facts["weights"]["field"] == 1.0 and facts["frame_exposure"] == pytest.approx(0.5, rel=1e-3)
    np.testing.assert_allclose(facts["camera"]["camera_to_world"], ring_pose(1, 9) @ field.rig["ms"], atol=1e-12)


def test_refuses_poses_that_do_not_fit(tmp_path: Path) -> None:
    field: Any = AnalyticField(sphere())
    scene = scene_of(field, tmp_path / "scene", views=2, truth=False)
    views = [PosedCamera(field.cameras["rgb"], ring_pose(0, 9), "0000")]
    to_ms: Any = {"source": "rgb", "target": "ms", "views": views}
    for arguments, message in [
        ({"method": "ratio"}, "method 'ratio' needs frames of rgb"),
        ({"images": [tmp_path / "0001.png"]}, r"0001\.png: no pose has this name, expected one of 0000"),
        ({"file_format": "jpg"}, "format is 'jpg', expected one of npz, exr, tiff"),
        ({"method": "magic", "images": [tmp_path / "0000.png"]}, "method is 'magic'"),
        ({"images": [tmp_path / "0000.png", tmp_path / "a" / "0000.png"]}, "two images have one name"),
    ]:
        with pytest.raises(InputError, match=message):
            convert_files(field, scene, tmp_path / "out", **to_ms, **arguments)
    del field.rig["ms"]
    with pytest.raises(InputError, match="'ms' has no known place on the rig of 'rgb'"):
        convert_files(field, scene, tmp_path / "out", **to_ms, as_sensor=True)
    assert not (tmp_path / "out").exists()
