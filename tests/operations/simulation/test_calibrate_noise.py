"""Noise figures from the frames of a scene: those that the frames were made with come back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic import MONO, MS, POL, RGB, AnalyticField, ring_pose, sphere

from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.files import write_text
from mmsynth.operations.simulation.calibrate_noise import by_modality, calibrate_from_frames, calibrate_noise, write
from mmsynth.operations.simulation.simulate import simulate
from mmsynth.scene.image_writers import write_npz, write_png
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.noise import NoiseModel, record
from mmsynth.sensors.sensor_file import SensorFile, load_sensor, sensor_to_toml

TRUE = NoiseModel(bits=12, gain_dn_e=0.4, full_well_e=1.2e4, read_e=6.0, black_dn=64.0, prnu=0.01)


class RoughField(AnalyticField):
    """As a fitted field is: off by two per cent here and there."""

    render_exactly = AnalyticField.render

    def render(self, *args: Any, **how: Any) -> Any:
        seen = self.render_exactly(*args, **how)
        v, u = np.mgrid[: seen.valid.shape[0], : seen.valid.shape[1]]
        for values in seen.channels.values():
            values *= (1.0 + 0.02 * np.sin(u / 5.0 + v / 7.0))[..., None].astype(np.float32)
        return seen


def sensor_file(name: str, folder: Path) -> Path:
    path = folder / f"{name}.toml"
    write_text(path, sensor_to_toml(SensorFile.model_validate({"name": name, "instance_of": name, "noise": TRUE})))
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of 6 views of 160 x 120 by four sensors, with noise."""
    folder = tmp_path_factory.mktemp("noise")
    field: Any = AnalyticField(sphere())
    camera = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
    field.cameras = dict.fromkeys(field.cameras, camera)
    # the frames' black level is part of what a field says
    offset = 64 / 4095.94
    exact = field.render

    def render(*args: Any, **how: Any) -> Any:
        seen = exact(*args, **how)
        for values in seen.channels.values():
            values += offset
        return seen

    field.render = render
    simulate(
        field,
        [sensor_file(s.name, folder) for s in (RGB, MS, POL, MONO)],
        folder / "scene",
        views=[PosedCamera(camera, ring_pose(i, 6), str(i)) for i in range(6)],
    )
    return folder


class WithBlack(RoughField):
    def render(self, *args: Any, **how: Any) -> Any:
        seen = super().render(*args, **how)
        for values in seen.channels.values():
            values += 64 / 4095.94
        return seen


def test_the_figures_of_a_scenes_sensors_come_back(made: Path, tmp_path: Path) -> None:
    field: Field = WithBlack(sphere())  # type: ignore[assignment]
    scene = load_scene(made / "scene")
    known = by_modality([load_sensor(made / f"{name}.toml") for name in ("rgb", "ms", "pol", "mono")])
    told: list[tuple[int, int]] = []
    found, failed = calibrate_noise(field, scene, known=known, progress=lambda done, total: told.append((done, total)))
    assert not failed and list(found) == list(scene.sensors) and told[-1][0] == told[-1][1]
    for c in found.values():
        p = c.found
        assert c.frames == 5 and p.gain_dn_e == pytest.approx(0.4, rel=0.1) and abs(p.gain_dn_e - 0.4) < 4 * p.gain_sd
        assert p.prnu == pytest.approx(0.01, abs=4 * p.prnu_sd) and 0 < p.prnu_sd < 0.005
        assert c.file.noise.black_dn == 64 and c.file.noise.full_well_e == pytest.approx(4031 / p.gain_dn_e, rel=1e-3)
    write(found, tmp_path)
    again = load_sensor(tmp_path / "rgb.toml")
    assert again == found["rgb"].file and again.instance_of == "rgb"
    assert (tmp_path / "rgb.toml").read_text().startswith("# noise: photon transfer of 5 frames")
    stored = json.loads((tmp_path / "noise.json").read_text())
    assert (
        stored["ms"]["gain_dn_e"] == found["ms"].found.gain_dn_e and len(stored["ms"]["mean_dn"]) == len(stored["ms"]["variance_dn2"]) > 3
    )
    assert "<svg" in (tmp_path / "noise.svg").read_text()


def test_without_a_file_bits_are_those_in_use_and_black_is_zero(made: Path) -> None:
    field: Field = WithBlack(sphere())  # type: ignore[assignment]
    (c,) = calibrate_noise(field, load_scene(made / "scene"), modalities=["mono"])[0].values()
    assert c.file.noise.bits == 12 and c.file.noise.black_dn == 0
    # variance over the mean with the black level taken for light: K is told too small, by what the curve's constant cannot take up
    assert 0.3 < c.found.gain_dn_e < 0.42


def test_other_frames_of_the_same_poses(made: Path, tmp_path: Path) -> None:
    field: Field = WithBlack(sphere())  # type: ignore[assignment]
    scene = load_scene(made / "scene")
    known = by_modality([load_sensor(made / "mono.toml")])
    raw = made / "scene" / "modalities"
    (all_of_them,) = calibrate_noise(field, scene, modalities=["mono"], known=known, raw=raw)[0].values()
    (two,) = calibrate_noise(field, scene, modalities=["mono"], known=known, raw=raw, views=[1, 2])[0].values()
    assert all_of_them.frames == 6 and two.frames == 2 and two.found.gain_dn_e == pytest.approx(0.4, rel=0.1)
    with pytest.raises(InputError, match="no frames of mono to calibrate from"):
        calibrate_noise(field, scene, modalities=["mono"], known=known, raw=tmp_path)


def test_frames_of_a_short_exposure_tell_the_read_noise(made: Path, tmp_path: Path) -> None:
    """At the full exposure read noise is 2 to 30 % of the variance and a rough field's own texture as much; at a sixteenth most of it."""
    exact, field = AnalyticField(sphere()), WithBlack(sphere())
    scene = load_scene(made / "scene")
    known = by_modality([load_sensor(made / "mono.toml")])
    for frame in scene.frames_of("mono"):
        light = torch.from_numpy(exact.render(frame.camera, exact.pose_of(frame), ["mono"]).channels["mono"][..., 0].astype(np.float64))
        exposure = (1 / 16 if frame.view % 2 else 1 / 12) * known["mono"].dn_at_one / (4095 - 64)  # 1 is 4095.94 DN to a field
        raw = record(exposure * light[None], TRUE, [frame.view], "short")[0].numpy()
        (tmp_path / "mono").mkdir(exist_ok=True)
        write_png(tmp_path / "mono" / f"{frame.view:04d}.png", raw.astype(np.uint16) << 4)
    (c,) = calibrate_noise(field, scene, modalities=["mono"], known=known, raw=tmp_path)[0].values()  # type: ignore[arg-type]
    assert c.exposure == pytest.approx([1 / 12, 1 / 16] * 3, rel=0.01)
    assert c.found.read_e == pytest.approx(6.0, rel=0.1) and abs(c.found.read_e - 6.0) < 4 * c.found.read_sd < 4
    assert c.found.gain_dn_e == pytest.approx(0.4, rel=0.1)


def test_from_frames_alone(tmp_path: Path) -> None:
    """A smooth picture of a 2 x 2 mosaic, 14 bits that are not moved up."""
    v, u = np.mgrid[:200, :260]
    light = 0.02 + 0.6 * (0.5 + 0.5 * np.sin(u / 40) * np.cos(v / 50)) ** 2 * np.array([[1.0, 0.5], [0.5, 0.25]])[v % 2, u % 2]
    model = NoiseModel(bits=14, gain_dn_e=1.5, full_well_e=1e5, read_e=8.0, black_dn=600.0)
    paths = []
    for i in range(3):
        raw = record(torch.from_numpy(light)[None], model, [i], "cam")[0].numpy().astype(np.uint16)
        paths.append(tmp_path / f"{i}.png")
        write_png(paths[-1], raw)
    described = {"name": "cam", "instance_of": "rgb", "mosaic": [[0, 1], [1, 2]], "alignment": "lsb"}
    noise = {"bits": 14, "gain_dn_e": 1.0, "full_well_e": 1.0, "black_dn": 600.0}
    file = SensorFile.model_validate(described | {"noise": noise})
    found = calibrate_from_frames(file, paths)
    assert found.found.gain_dn_e == pytest.approx(1.5, rel=0.05) and found.frames == 3
    for wrong, message in (({"alignment": "msb"}, "low 2 bits are in use"), ({"noise": noise | {"bits": 10}}, "expected at most 1023")):
        with pytest.raises(InputError, match=message):
            calibrate_from_frames(SensorFile.model_validate(described | {"noise": noise} | wrong), paths)
    with pytest.raises(InputError, match="no frames"):
        calibrate_from_frames(file, [])


def test_a_sensor_that_saw_texture_alone_does_not_keep_the_others_back(made: Path) -> None:
    field: Field = WithBlack(sphere())  # type: ignore[assignment]
    exact = field.render

    def rough(*args: Any, **how: Any) -> Any:
        seen = exact(*args, **how)
        if "rgb" in seen.channels:
            seen.channels["rgb"] *= 1.0 + 0.3 * np.random.default_rng(0).normal(size=seen.channels["rgb"].shape).astype(np.float32)
        return seen

    field.render = rough  # type: ignore[method-assign]
    known = by_modality([load_sensor(made / f"{name}.toml") for name in ("rgb", "mono")])
    found, failed = calibrate_noise(field, load_scene(made / "scene"), modalities=["rgb", "mono"], known=known)
    assert list(found) == ["mono"] and list(failed) == ["rgb"]
    assert failed["rgb"].startswith("rgb: photon transfer: ")


def test_what_is_no_converters_is_refused(made: Path, tmp_path: Path) -> None:
    field: Field = WithBlack(sphere())  # type: ignore[assignment]
    scene = load_scene(made / "scene")
    known = load_sensor(made / "mono.toml")
    with pytest.raises(InputError, match="'thermal': not in this field"):
        calibrate_noise(field, scene, modalities=["thermal"])
    with pytest.raises(InputError, match="expected one file for each captured sensor"):
        by_modality([known, known])
    flat = tmp_path / "flat.png"
    write_png(flat, np.full((120, 160), 1600, np.uint16))
    with pytest.raises(InputError, match="mono: photon transfer: the values have no range of light"):
        calibrate_from_frames(known, [flat])
    write_npz(tmp_path / "float.npz", {"data": np.random.default_rng(0).random((120, 160)).astype(np.float32)})
    with pytest.raises(InputError, match="pixels of type float32, expected uint16"):
        calibrate_from_frames(known, [tmp_path / "float.npz"])
