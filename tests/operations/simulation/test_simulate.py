"""Raw frames of imagined sensors, on a field that is known in closed form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rawpy
from analytic import MONO, MS, POL, RGB, AnalyticField, ring_pose, scene_of, sphere

from mmsynth.errors import InputError
from mmsynth.operations.simulation.frames import simulate_frame
from mmsynth.operations.simulation.plan import plan_sensor
from mmsynth.operations.simulation.simulate import expected_errors, simulate
from mmsynth.scene.images import read_native
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import PosedCamera, Region
from mmsynth.sensors.camera import Camera

CLEAN = "[noise]\nbits = 12\ngain_dn_e = 1e-3\nfull_well_e = 1e7\n"
VIEWS = [PosedCamera(AnalyticField(sphere()).cameras["rgb"], ring_pose(i, 4), f"{i:04d}") for i in range(4)]


@pytest.fixture
def field() -> Any:
    return AnalyticField(sphere())


def write(folder: Path, name: str, head: str, noise: str = CLEAN) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(f'name = "{name}"\n{head}\n{noise}')
    return path


def numbers(out: Path, name: str, view: int, suffix: str = "png") -> np.ndarray:
    return read_native(out / "modalities" / name / f"{view:04d}.{suffix}")


# --- instances


@pytest.mark.parametrize("sensor", [RGB, MS, POL, MONO], ids=lambda s: s.name)
def test_the_twin_of_a_sensor_records_what_the_sensor_did(field: Any, tmp_path: Path, sensor: Any) -> None:
    """Photosite for photosite, but for its rounding to 12 bits; and not when the mosaic is shifted by one pixel."""
    scene = scene_of(field, tmp_path / "scene", truth=False)
    file = write(tmp_path, sensor.name, f'instance_of = "{sensor.name}"', CLEAN.replace("1e-3", "1e-6").replace("1e7", "1e10"))
    simulate(field, [file], tmp_path / "out", scene=scene, frames=[0, 3])
    for view in (0, 3):
        real = read_native(next(f.path for f in scene.frames_of(sensor.name) if f.view == view)).astype(float)
        twin = numbers(tmp_path / "out", sensor.name, view).astype(float)
        # half a step of 16, half a step of the real one, and five deviations of the shot noise of 10^9 electrons
        assert np.abs(twin - real).max() <= 8 + 0.5 + 5
        if sensor.mosaic is not None:
            for shift in ((0, 1), (1, 0)):
                inner = (slice(2, -2), slice(2, -2))
                assert np.abs(np.roll(twin, shift, (0, 1)) - real)[inner].mean() > 20 * np.abs(twin - real)[inner].mean()


def test_a_simulated_rig_is_a_scene_again(field: Any, tmp_path: Path) -> None:
    field.region = Region((0.2, -0.1, 0.3), 1.5)
    files = [write(tmp_path, s.name, f'instance_of = "{s.name}"') for s in (RGB, POL, MS, MONO)]
    simulate(field, files, tmp_path / "out", views=VIEWS)
    scene = load_scene(tmp_path / "out")
    assert list(scene.sensors) == ["rgb", "pol", "ms", "mono"] and not scene.problems and scene.unit == "m"
    np.testing.assert_allclose([*scene.region.centre, scene.region.radius], [0.2, -0.1, 0.3, 1.5], atol=1e-12)
    for sensor in (RGB, POL, MS, MONO):
        again = scene.sensors[sensor.name]
        assert again.channels == sensor.channels and again.polarizer_angles_deg == sensor.polarizer_angles_deg
        assert (again.mosaic is None) == (sensor.mosaic is None) and np.array_equal(again.mosaic, sensor.mosaic)
        for i, frame in enumerate(scene.frames_of(sensor.name)):
            np.testing.assert_allclose(frame.camera_to_world, ring_pose(i, 4) @ field.rig[sensor.name], atol=1e-12)
            assert frame.camera.intrinsics.tolist() == field.cameras[sensor.name].intrinsics.tolist()
            np.testing.assert_array_equal(frame.camera.coefficients, field.cameras[sensor.name].coefficients)
    aligned = simulate(field, files, tmp_path / "aligned", views=VIEWS, rig="aligned")
    for frame in load_scene(aligned.parent).frames:
        np.testing.assert_allclose(frame.camera_to_world, ring_pose(frame.view, 4), atol=1e-12)


def test_an_instance_is_called_as_its_modality_whatever_its_file_is_called(field: Any, tmp_path: Path) -> None:
    out = simulate(field, [write(tmp_path, "basler_7", 'instance_of = "rgb"')], tmp_path / "out", views=VIEWS)
    assert list(load_scene(out.parent).sensors) == ["rgb"]


def test_a_field_in_no_unit_stays_in_none(field: Any, tmp_path: Path) -> None:
    field.unit = "input unit"
    out = simulate(field, [write(tmp_path, "rgb", 'instance_of = "rgb"')], tmp_path / "out", views=VIEWS)
    assert load_scene(out.parent).unit == "input unit"


@pytest.mark.parametrize(
    "effect", ["exposure = 2.0", "psf_sigma_px = 0.5", "vignetting = [-0.1, 0.0, 0.0]", "cos4 = true", "polarizer_angle_sd_deg = 1.0"]
)
def test_what_the_field_has_is_not_applied_twice(field: Any, tmp_path: Path, effect: str) -> None:
    file = write(tmp_path, "pol", f'instance_of = "pol"\n{effect}')
    with pytest.raises(InputError, match=rf"pol\.toml: {effect.split()[0]}: the field learned from the frames of pol"):
        plan_sensor(field, file)
    assert plan_sensor(field, file, delta=True).file.instance_of == "pol"
    with pytest.raises(InputError, match=r"noise\.crosstalk: the field has"):
        plan_sensor(field, write(tmp_path, "pol", 'instance_of = "pol"', CLEAN + "crosstalk = 0.02\n"))


def test_a_delta_is_applied_on_top(field: Any, tmp_path: Path) -> None:
    plain = plan_sensor(field, write(tmp_path, "mono", 'instance_of = "mono"'))
    dimmer = plan_sensor(field, write(tmp_path, "mono", 'instance_of = "mono"\nexposure = 0.5'), delta=True)
    camera, pose = VIEWS[0].camera, VIEWS[0].camera_to_world
    a, b = (simulate_frame(field, p, PosedCamera(camera, pose), 0).astype(float) for p in (plain, dimmer))
    np.testing.assert_allclose(b, 0.5 * a, atol=4)


def test_facts_about_a_captured_sensor_are_not_applied(field: Any, tmp_path: Path) -> None:
    """Analysers that the file describes are in what the field learned; only a delta applies them, to its Stokes vectors."""
    channels = "".join(
        f'[[channels]]\nlabel = "{c}"\npolarizer = {{angle_deg = {a}, extinction_ratio = 5.0}}\n'
        for c, a in zip(POL.channels, POL.polarizer_angles_deg or (), strict=True)
    )
    file = write(tmp_path, "pol", f'instance_of = "pol"\n{channels}')
    camera, pose = VIEWS[0].camera, VIEWS[0].camera_to_world
    plain, facts, delta = (
        simulate_frame(field, p, PosedCamera(camera, pose), 0).astype(float)
        for p in (
            plan_sensor(field, write(tmp_path, "pol2", 'instance_of = "pol"')),
            plan_sensor(field, file),
            plan_sensor(field, file, delta=True),
        )
    )
    assert np.abs(facts - plain).max() < 20
    stokes = field.render(camera, pose, ["pol"]).stokes["pol"]
    contrast = (5 - 1) / (5 + 1)
    for row, column, angle in ((0, 0, 90.0), (0, 1, 45.0), (1, 0, 135.0), (1, 1, 0.0)):
        a = 2 * np.radians(angle)
        expected = stokes[row::2, column::2] @ [0.5, 0.5 * contrast * np.cos(a), 0.5 * contrast * np.sin(a)] * 4095.94
        np.testing.assert_allclose(delta[row::2, column::2], expected, atol=12)
    assert np.abs(delta - plain).max() > 100


def test_black_level_is_recorded_once(field: Any, tmp_path: Path) -> None:
    """A field that learned from frames with a black level says it as light; the twin must not add it again."""
    noise = CLEAN + "black_dn = 64.0\n"
    camera, pose = VIEWS[0].camera, VIEWS[0].camera_to_world
    a = simulate_frame(field, plan_sensor(field, write(tmp_path, "mono", 'instance_of = "mono"')), PosedCamera(camera, pose), 0)
    b = simulate_frame(field, plan_sensor(field, write(tmp_path, "mono", 'instance_of = "mono"', noise)), PosedCamera(camera, pose), 0)
    assert np.abs(a.astype(float) - b).max() <= 12  # shot noise alone, of some electrons more


# --- virtual sensors


def response(centre: float, fwhm: float = 40.0) -> str:
    return f"response = {{centre_nm = {centre}, fwhm_nm = {fwhm}}}\n"


def measured(folder: Path) -> Path:
    channels = "".join(
        f'[[channels]]\nlabel = "{c}"\n{response(w) if w else ""}' for c, w in zip(MS.channels, MS.wavelengths_nm, strict=True)
    )
    return write(folder, "captured", f'instance_of = "ms"\n{channels}')


def test_a_virtual_channel_that_is_a_measured_one_is_it(field: Any, tmp_path: Path) -> None:
    measured(tmp_path)
    head = 'measured = ["captured.toml"]\n[camera]\nwidth = 24\nheight = 18\nfx = 26.0\nfy = 26.0\ncx = 11.5\ncy = 8.5\n'
    file = write(tmp_path, "band", f'{head}[[channels]]\nlabel = "x"\n{response(572.0)}')
    planned = plan_sensor(field, file)
    assert planned.combinations["x"].residual < 0.03 and planned.modalities == ("ms",) and planned.supersampling == 2
    camera = planned.camera
    assert camera is not None
    raw = simulate_frame(field, planned, PosedCamera(camera, VIEWS[0].camera_to_world), 0).astype(float)
    truth = field.render(camera, VIEWS[0].camera_to_world, ["ms"]).channels["ms"][..., 3] * 4095.94
    assert abs(np.median(raw / truth) - 1) < 0.01
    out = simulate(field, [file], tmp_path / "out", views=VIEWS[:1])
    error = f"{planned.combinations['x'].residual:.1%}"
    assert expected_errors(out.parent) == [f"band: 1 channels made of measured ones, expected errors {error} to {error} (x)"]


def test_what_cannot_be_expressed_is_refused_with_the_reason(field: Any, tmp_path: Path) -> None:
    measured(tmp_path)
    for centre, words in ((900.0, "where no measured channel responds, 8"), (1300.0, "100% of its response lies")):
        file = write(tmp_path, "nir2", f'measured = ["captured.toml"]\n[[channels]]\nlabel = "x"\n{response(centre)}')
        with pytest.raises(InputError, match=rf"channels: x: the measured channels cannot express it.*{words}"):
            plan_sensor(field, file)


def test_trained_channels_in_another_mosaic(field: Any, tmp_path: Path) -> None:
    """R G / G B of another size, where the field learned from G B / R G."""
    channels = "".join(f'[[channels]]\nlabel = "{c}"\nof = "rgb.{c}"\n' for c in "RGB")
    camera = "[camera]\nwidth = 40\nheight = 30\nfx = 44.0\nfy = 44.0\ncx = 19.5\ncy = 14.5\n"
    file = write(tmp_path, "bayer", f"mosaic = [[0, 1], [1, 2]]\nsupersampling = 1\n{camera}{channels}")
    planned = plan_sensor(field, file)
    assert planned.camera is not None
    raw = simulate_frame(field, planned, PosedCamera(planned.camera, VIEWS[0].camera_to_world), 0).astype(float)
    truth = field.render(planned.camera, VIEWS[0].camera_to_world, ["rgb"]).channels["rgb"] * 4095.94
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        np.testing.assert_allclose(raw[row::2, column::2], truth[row::2, column::2, channel], rtol=0.01, atol=8)


def test_a_polarization_camera_of_another_pattern(field: Any, tmp_path: Path) -> None:
    """Its Stokes vectors, by least squares over its own angles and extinction, are those of the field; colours keep their level."""
    angles = (10.0, 70.0, 130.0)
    channels = "".join(f'[[channels]]\nlabel = "a{a:.0f}"\npolarizer = {{angle_deg = {a}, extinction_ratio = 50.0}}\n' for a in angles)
    file = write(tmp_path, "tri", f"mosaic = [[0, 1, 2]]\nsupersampling = 1\n{channels}", CLEAN)
    camera, pose = VIEWS[0].camera, VIEWS[0].camera_to_world
    raw = simulate_frame(field, plan_sensor(field, file), PosedCamera(camera, pose), 0).astype(float) / 4095
    contrast = 49 / 51
    rows = [[0.5, 0.5 * contrast * np.cos(2 * np.radians(a)), 0.5 * contrast * np.sin(2 * np.radians(a))] for a in angles]
    stokes = field.render(camera, pose, ["pol"]).stokes["pol"]
    for k in range(3):
        np.testing.assert_allclose(raw[:, k::3], stokes[:, k::3] @ rows[k], rtol=0.01, atol=2e-3)
    coloured = channels.replace("polarizer", 'of = "rgb.G"\npolarizer')
    of_green = simulate_frame(
        field,
        plan_sensor(field, write(tmp_path, "tri2", f"mosaic = [[0, 1, 2]]\nsupersampling = 1\n{coloured}")),
        PosedCamera(camera, pose),
        0,
    )
    green = field.render(camera, pose, ["rgb"]).channels["rgb"][..., 1]
    for k in range(3):
        share = (stokes[:, k::3] @ rows[k]) / stokes[:, k::3, 0]
        np.testing.assert_allclose(of_green[:, k::3] / 4095, green[:, k::3] * share, rtol=0.01, atol=2e-3)


def test_supersampling_is_the_mean_over_the_pixel(field: Any, tmp_path: Path) -> None:
    head = '[[channels]]\nlabel = "x"\nof = "mono.mono"\n'
    camera, pose = VIEWS[0].camera, VIEWS[0].camera_to_world
    frames = {
        s: simulate_frame(
            field, plan_sensor(field, write(tmp_path, "v", f"supersampling = {s}\n{head}")), PosedCamera(camera, pose), 0
        ).astype(float)
        for s in (1, 2, 4, 8, 16)
    }
    errors = [np.sqrt(np.mean((frames[s] - frames[16]) ** 2)) for s in (1, 2, 4)]
    assert errors[0] > 1.5 * errors[1] > 2.0 * errors[2]


def test_a_blurred_strip_is_part_of_the_blurred_picture(field: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mmsynth.operations.simulation import frames as module

    planned = plan_sensor(field, write(tmp_path, "v", 'psf_sigma_px = 1.3\n[[channels]]\nlabel = "x"\nof = "mono.mono"\n'))
    whole = module.render_light(field, planned, VIEWS[0])
    for rays in (1, 48 * 2 * 7, 48 * 2 * 12):
        monkeypatch.setattr(module, "_STRIP_RAYS", rays)
        np.testing.assert_allclose(module.render_light(field, planned, VIEWS[0]), whole, atol=1e-6)


# --- files


def test_the_same_bytes_whatever_else_is_made(field: Any, tmp_path: Path) -> None:
    noisy = CLEAN.replace("1e-3", "0.4").replace("1e7", "1e4") + "read_e = 5.0\nprnu = 0.01\n"
    rgb, mono = (write(tmp_path, n, f'instance_of = "{n}"', noisy) for n in ("rgb", "mono"))
    simulate(field, [rgb, mono], tmp_path / "a", views=VIEWS, seed=3)
    simulate(field, [mono], tmp_path / "b", views=VIEWS[::-1], seed=3)
    other = simulate(field, [mono], tmp_path / "c", views=VIEWS[:1], seed=4)
    for i in range(4):
        a, b = (tmp_path / x / "modalities" / "mono" / f"{i:04d}.png" for x in "ab")
        assert a.read_bytes() == b.read_bytes()
    assert (numbers(other.parent, "mono", 0) != numbers(tmp_path / "a", "mono", 0)).mean() > 0.5
    # the pattern of the response stays from frame to frame: with it alone, frames of one light have it in common
    facts = json.loads((tmp_path / "a" / "sidecars" / "mono" / "0002.json").read_text())
    assert facts["seed"] == 3 and facts["frame"] == 2 and facts["sensor"]["noise"]["read_e"] == 5.0 and facts["kind"] == "instance"


def test_it_goes_on_where_it_was(field: Any, tmp_path: Path) -> None:
    file, out = write(tmp_path, "mono", 'instance_of = "mono"'), tmp_path / "out"
    simulate(field, [file], out, views=VIEWS)
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    made = field.renders
    simulate(field, [file], out, views=VIEWS)
    assert field.renders == made and before == {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    # one frame damaged, one of another request
    (out / "modalities" / "mono" / "0001.png").write_bytes(b"cut")
    sidecar = out / "sidecars" / "mono" / "0002.json"
    sidecar.write_text(sidecar.read_text().replace('"seed": 0', '"seed": 1'))
    simulate(field, [file], out, views=VIEWS)
    assert field.renders == made + 2 and before == {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}


def test_a_run_cut_off_leaves_no_scene(field: Any, tmp_path: Path) -> None:
    """Frames of two requests must not be taken for one scene."""
    file, out = write(tmp_path, "mono", 'instance_of = "mono"'), tmp_path / "out"
    simulate(field, [file], out, views=VIEWS)

    def stop(done: int, total: int) -> None:
        if done > total // 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(field, [file], out, views=VIEWS, seed=1, progress=stop)
    assert not (out / "meta_data.json").exists()
    simulate(field, [file], out, views=VIEWS, seed=1)
    simulate(field, [file], tmp_path / "whole", views=VIEWS, seed=1)
    for i in range(4):
        assert (numbers(out, "mono", i) == numbers(tmp_path / "whole", "mono", i)).all()


def test_dng_is_what_others_read(field: Any, tmp_path: Path) -> None:
    large = "[camera]\nwidth = 64\nheight = 48\nfx = 70.0\nfy = 70.0\ncx = 31.5\ncy = 23.5\n"
    file = write(tmp_path, "rgb", f'instance_of = "rgb"\n{large}', CLEAN + "black_dn = 64.0\n")
    simulate(field, [file], tmp_path / "dng", views=VIEWS[:3], file_format="dng")
    simulate(field, [file], tmp_path / "png", views=VIEWS[:2])
    raw = rawpy.imread(str(tmp_path / "dng" / "modalities" / "rgb" / "0000.dng"))
    expected = numbers(tmp_path / "png", "rgb", 0)
    np.testing.assert_array_equal(raw.raw_image, expected)
    letters = np.array(list(raw.color_desc.decode()))[raw.raw_pattern]
    assert letters.tolist() == [["G", "B"], ["R", "G"]]
    assert raw.black_level_per_channel == [64 * 16] * 4 and raw.white_level == 4095 * 16
    np.testing.assert_array_equal(numbers(tmp_path / "dng", "rgb", 1, "dng"), numbers(tmp_path / "png", "rgb", 1))
    scene = load_scene(tmp_path / "dng")
    assert len(scene.frames) == 3 and np.array_equal(scene.sensors["rgb"].mosaic, RGB.mosaic)


def test_bits_and_alignment(field: Any, tmp_path: Path) -> None:
    for bits, alignment, kind, top in ((8, "msb", np.uint8, 255), (10, "msb", np.uint16, 1023 << 6), (10, "lsb", np.uint16, 1023)):
        noise = f"[noise]\nbits = {bits}\ngain_dn_e = 1e-3\nfull_well_e = 1e7\n"
        file = write(
            tmp_path,
            f"b{bits}{alignment}",
            f'alignment = "{alignment}"\nexposure = 9.0\n[[channels]]\nlabel = "x"\nof = "mono.mono"',
            noise,
        )
        simulate(field, [file], tmp_path / "out" / alignment, views=VIEWS[:1])
        stored = numbers(tmp_path / "out" / alignment, f"b{bits}{alignment}", 0)
        assert stored.dtype == kind and stored.max() == top


def test_bad_requests_are_refused_before_anything_is_made(field: Any, tmp_path: Path) -> None:
    rgb, out = write(tmp_path, "rgb", 'instance_of = "rgb"'), tmp_path / "out"
    ms = write(tmp_path, "ms", 'instance_of = "ms"')
    thermal = write(tmp_path, "t", 'instance_of = "thermal"')
    phase = write(tmp_path, "p", 'instance_of = "rgb"\nmosaic = [[0, 1], [1, 2]]')
    labels = write(tmp_path, "l", 'instance_of = "rgb"\n' + "".join(f'[[channels]]\nlabel = "{c}"\n' for c in "BGR"))
    unknown = write(tmp_path, "u", '[[channels]]\nlabel = "x"\nof = "rgb.X"')
    own = write(tmp_path, "own", '[[channels]]\nlabel = "x"\nof = "mono.mono"')
    two = [VIEWS[0], PosedCamera(Camera(10, 10, 9.0, 9.0, 5.0, 5.0), VIEWS[1].camera_to_world, "1")]
    cases: list[tuple[Any, Any, dict[str, Any], str]] = [
        ([rgb], [], {}, "no views"),
        ([], VIEWS, {}, "no sensor"),
        ([rgb, rgb], VIEWS, {}, "two sensors are called 'rgb'"),
        ([rgb], VIEWS, {"file_format": "jpg"}, "format is 'jpg'"),
        ([rgb], VIEWS, {"rig": "loose"}, "rig is 'loose'"),
        ([ms], VIEWS, {"file_format": "dng"}, "DNG holds 2x2 Bayer"),
        ([thermal], VIEWS, {}, "instance_of: 'thermal' is not in this field"),
        ([phase], VIEWS, {}, r"mosaic: \[\[0, 1\], \[1, 2\]\] is not that of rgb"),
        ([labels], VIEWS, {}, "channels are B, G, R, expected those of rgb: R, G, B"),
        ([unknown], VIEWS, {}, r"no trained channel 'rgb\.X', expected one of rgb\.R"),
        (["nowhere"], VIEWS, {}, "sensor 'nowhere': not found"),
        ([own], two, {}, "2 cameras of 'own'"),
    ]
    for sensors, views, how, message in cases:
        with pytest.raises(InputError, match=message):
            simulate(field, sensors, out, views=views, **how)
        assert not out.exists(), message
