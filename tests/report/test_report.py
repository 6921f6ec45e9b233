"""The page of a run is one file that says what was measured and what the field makes of it, with nothing fetched from anywhere."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from analytic import AnalyticField, WrongField, scene_of, sphere
from page_reader import check, picture_of

from mmsynth.operations.evaluation.evaluate import evaluate
from mmsynth.operations.output import previews
from mmsynth.report.report import curve_svg, measured_channels, read_log, write_run_report
from mmsynth.report.run_pictures import picture_rows
from mmsynth.scene.image_writers import write_png, write_png16
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, MaskMeaning, Sensor
from mmsynth.sensors.camera import Camera


class HalfPredicted(AnalyticField):
    """No sensor measured its ms and pol: a prior says them, sure to a tenth."""

    def __init__(self) -> None:
        super().__init__(sphere())
        self.predicted = ["pol", "ms"]
        self.measured = ["rgb", "mono"]

    def render(self, *args: Any, **how: Any) -> Any:
        seen = super().render(*args, **how)
        return replace(seen, deviation={name: 0.1 * seen.channels[name] for name in self.predicted if name in seen.channels})


MANIFEST = {
    "needs": {
        "choices": {
            "background": {"value": False, "why": "off: <nothing> there", "changed": False},
            "tables": {"value": [15, 16.5], "why": "rows: enough", "changed": True},
        },
        "footprint": 0.01,
    },
    "seed": 7,
    "seconds": {"fit": 60.5},
}
LOG = [{"step": i, "elapsed": 1.0 * i, "loss": 1 / (i + 1), "psnr": {"rgb": 20.0 + i}} for i in range(5)]


def test_report(tmp_path: Path) -> None:
    field = WrongField(sphere())
    field.wrong = False
    scene = scene_of(field, tmp_path / "scene")
    field.wrong, field.manifest = True, MANIFEST
    evaluation = evaluate(field, scene) | {"moved_px": {"3": 0.5}}  # type: ignore[arg-type]
    (tmp_path / "field.safetensors").write_bytes(b"0" * 2500)
    (tmp_path / "mesh of it.ply").write_text("ply")
    path = write_run_report(tmp_path, field, evaluation=evaluation, train_log=LOG, scene=scene)  # type: ignore[arg-type]
    page = check(path)
    assert "&lt;nothing&gt;" in page.source and "<nothing>" not in page.source
    for text in ("PSNR [dB]", "spectral angle", "depth error", "<svg", "Test views: 3.", "off by 0.50 pixels"):
        assert text in page.source
    assert page.table("what was decided and why") == [
        ["choice", "value", "why"],
        ["background", "off", "<nothing> there"],
        ["tables", "15, 16.5", "rows: enough"],
    ]
    assert ["seconds.fit", "60.5"] in page.table("The run") and ["footprint", "0.01"] in page.table("What the scene needed")
    assert [row[0] for row in page.table("PSNR of highlights, silhouettes and the rest")[1:]] == ["ms", "pol", "mono"]
    links = {a.attributes["href"]: a.parent.whole_text() for a in page.root.all("ul", class_="files")[0].all("a") if a.parent is not None}
    assert set(links) == {"field.safetensors", "mesh%20of%20it.ply", "preview.png"} and "2.5 kB" in links["field.safetensors"]
    titles = [section.all("h3")[0].text for section in page.root.all("section", class_="modality")]
    assert titles == ["rgb", "ms", "pol", "mono", "geometry"]
    sections = dict(zip(titles, page.root.all("section", class_="modality"), strict=True))
    assert {name: len(section.all("figure", class_="wipe")) for name, section in sections.items()} == {
        "rgb": 1, "ms": 1, "pol": 3, "mono": 1, "geometry": 0
    }  # fmt: skip
    assert all(len(section.all("div", class_="strip")) == 1 for section in sections.values())


def test_pictures_and_embedded_light_are_those_of_the_field_and_the_frame(tmp_path: Path) -> None:
    field = WrongField(sphere())
    field.wrong = False
    scene = scene_of(field, tmp_path / "scene")
    field.wrong = True
    page = check(write_run_report(tmp_path, field, scene=scene))  # type: ignore[arg-type]
    spectra = page.spectra()
    assert set(spectra) == set(field.sensors)
    errors = {}
    for name, sensor in field.sensors.items():
        (frame,) = scene.frames_of(name, (3,))
        stored, ours, theirs = (
            spectra[name],
            field.render(frame.camera, frame.camera_to_world).channels[name],
            measured_channels(sensor, frame, "off"),
        )
        assert stored["channels"] == list(sensor.channels) and stored["nm"] == list(sensor.wavelengths_nm) and stored["cell"] == [1.0, 1.0]
        step = (stored["high"] - stored["low"]) / 65534
        np.testing.assert_allclose(stored["rendered"], ours, atol=0.51 * step)
        np.testing.assert_allclose(stored["measured"], theirs, atol=0.51 * step)
        assert np.isfinite(ours).any() and np.abs(ours - theirs)[np.isfinite(ours)].max() > 0.02
        errors[name] = np.abs(ours - theirs).mean(-1)
    # one scale for all: a pixel is as bright as its error is large, whatever the modality
    ends, seen = set(), []
    for section in page.root.all("section", class_="modality"):
        for image in section.all("img"):
            if "map of the error" in image.attributes["alt"]:
                assert image.parent is not None and image.parent.parent is not None
                ends.add(image.parent.parent.all("span", class_="scale")[0].whole_text().strip())
                error = errors[section.all("h3")[0].text]
                where = np.isfinite(error)
                seen.append(np.stack([error[where], picture_of(image).astype(float).mean(-1)[where]]))
    (text,) = ends
    found = re.fullmatch(r"0\s*([\d.]+) of full scale", text)
    assert found is not None
    error, brightness = np.concatenate(seen, 1)
    high = float(found[1])
    assert 0.5 * np.percentile(error, 99) < high < 3 * error.max()
    order = np.argsort(error[error < high])
    assert (np.diff(brightness[error < high][order]) >= -1.5).all() and brightness.max() - brightness.min() > 50


def test_of_a_large_frame_every_nth_pixel_is_rendered_and_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    field = WrongField(sphere())
    field.wrong = False
    scene = scene_of(field, tmp_path / "scene")
    monkeypatch.setattr(previews, "LARGEST", 9)
    asked: list[Camera] = []
    render = field.render
    monkeypatch.setattr(field, "render", lambda camera, *args, **how: asked.append(camera) or render(camera, *args, **how))
    _, rows = picture_rows(field, scene)  # type: ignore[arg-type]
    assert len(asked) == 4 and {(camera.width, camera.height) for camera in asked} == {(8, 6)}
    assert {picture.image.shape[:2] for row in rows for picture in row.each()} == {(6, 8)}
    # of a sensor without mosaic the frame is what is rendered, pixel for pixel, but for its 16 bits
    mono = next(row for row in rows if row.title == "mono")
    (error,) = [picture for picture in mono.each() if picture.caption.startswith("error")]
    assert float(error.caption.removeprefix("error, mean ")) < 1e-5


def test_predicted_modalities_say_so_with_their_deviation(tmp_path: Path) -> None:
    field = HalfPredicted()
    scene = scene_of(field, tmp_path / "scene")
    page = check(write_run_report(tmp_path, field, scene=scene))  # type: ignore[arg-type]
    sections = {s.all("h3")[0].text.strip(): s for s in page.root.all("section", class_="modality")}
    assert list(sections) == ["rgb", "mono", "pol", "ms", "geometry"]
    assert [name for name, s in sections.items() if "predicted, not measured" in s.all("h3")[0].whole_text()] == ["pol", "ms"]
    (frame,) = scene.frames_of("rgb", (3,))
    stored = page.spectra()["ms"]
    ours = field.render(frame.camera, frame.camera_to_world).channels["ms"]
    assert "measured" not in stored
    np.testing.assert_allclose(stored["rendered"], ours, atol=1e-5)
    np.testing.assert_allclose(stored["deviation"], 0.1 * ours, atol=1e-5)
    assert any("standard deviation" in image.attributes["alt"] for image in sections["ms"].all("img"))


def test_report_of_a_bare_run(tmp_path: Path) -> None:
    """No scene, no scores, no log: still a page."""
    page = check(write_run_report(tmp_path, AnalyticField(sphere())))  # type: ignore[arg-type]
    assert not page.root.all("svg") and not page.root.all("img") and not (tmp_path / "preview.png").exists()


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
    shown = measured_channels(sensor, Frame("rgb", 0, tmp_path / "0.png", Camera(30, 20, 20.0, 20.0, 15.0, 10.0), np.eye(4)), "off")
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
    shown = measured_channels(Sensor("rgb", ("R", "G", "B"), (None, None, None)), frame, "off")
    np.testing.assert_allclose(shown, rgba[..., :3] * rgba[..., 3:], atol=2e-5)
    assert not shown[:10].any()


@pytest.mark.parametrize(("masks", "black", "error"), [("object", True, 0.026), ("ignore", False, 0.0), ("off", False, 0.65)])
def test_what_is_outside_of_a_mask_is_shown_as_it_is_scored(masks: MaskMeaning, black: bool, error: float, tmp_path: Path) -> None:
    """Frames whose outside, two thirds of them, was painted white, by a field that has 0.04 there."""
    sensor = Sensor("rgb", ("R", "G", "B"), (None, None, None))
    field = AnalyticField(sphere(), [sensor])
    scene = scene_of(field, tmp_path)
    frames = []
    for frame in scene.frames:
        inside = field.render(frame.camera, frame.camera_to_world).opacity > 0.5
        write_png16(frame.path, np.where(inside[..., None], load_frame(sensor, frame)[0], 1.0))
        write_png(tmp_path / f"{frame.view}.png", inside.astype(np.uint8) * 255)
        frames.append(replace(frame, mask=tmp_path / f"{frame.view}.png"))
    _, (row, _) = picture_rows(field, replace(scene, frames=tuple(frames), masks=masks))  # type: ignore[arg-type]
    shown, _, _, errors = row.each()
    assert shown.caption == "frame 3" and (shown.image[0] < 10 if black else shown.image[0] > 200).all()
    assert float(errors.caption.removeprefix("error, mean ")) == pytest.approx(error, abs=1e-3 + 0.1 * error)
