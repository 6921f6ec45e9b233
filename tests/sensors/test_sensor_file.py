"""Sensor files: the packaged ones, what comes back from TOML, and the sentence that refuses what cannot be."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from mmsynth.errors import InputError
from mmsynth.files import write_text
from mmsynth.packaged import data_folder
from mmsynth.sensors.camera import Camera, Lens
from mmsynth.sensors.noise import NoiseModel
from mmsynth.sensors.sensor_file import (
    Channel,
    Polarizer,
    Response,
    SensorFile,
    find_sensor_file,
    load_sensor,
    sensor_to_toml,
)

PACKAGED = sorted((data_folder("recipes") / "sensors").glob("*.toml"))
NOISE = NoiseModel(bits=12, gain_dn_e=0.4, full_well_e=10500.0)
GOOD = """
name = "cam"
{top}
[[channels]]
label = "a"
{channel}
[noise]
{noise}
{end}
"""
FIGURES = "bits = 12\ngain_dn_e = 0.4\nfull_well_e = 1e4"
CAMERA = "[camera]\nwidth = 4\nheight = 3\nfx = 5.0\nfy = 5.0\ncx = 1.5\ncy = 1.0\n"


def _write(folder: Path, top: str = "", channel: str = 'of = "rgb.R"', noise: str = FIGURES, end: str = "") -> Path:
    path = folder / "cam.toml"
    path.write_text(GOOD.format(top=top, channel=channel, noise=noise, end=end), encoding="utf-8")
    return path


def _refusal(path: Path) -> str:
    """What is said, which must be ONE sentence and begin with the file."""
    with pytest.raises(InputError) as refused:
        load_sensor(path)
    said = str(refused.value)
    rest = said.removeprefix(f"{path}: ")
    assert rest != said and "\n" not in said and said.endswith(".") and not said.endswith("..") and ". " not in rest, said
    return rest


# --- packaged files


@pytest.mark.parametrize("path", PACKAGED, ids=lambda p: p.stem)
def test_packaged_sensors_load_and_say_where_their_figures_come_from(path: Path) -> None:
    file = load_sensor(path)
    assert file.name == path.stem and len(file.source) > 100 and file.description
    for other in file.measured:
        assert load_sensor(find_sensor_file(other, path.parent)).instance_of is not None
    if file.mosaic is not None:
        assert np.bincount(np.ravel(file.mosaic)).all()
    if file.kind == "instance":
        # blur, vignetting and analysers are in what the field learned already
        given = file.model_dump(exclude_defaults=True)
        effects = {"exposure", "psf_sigma_px", "vignetting", "cos4", "polarizer_angle_sd_deg", "off_axis", "camera", "camera_to_reference"}
        assert not effects & set(given)
    else:
        assert file.camera is not None and (file.camera.width, file.camera.height) > (600, 400)
    # full scale of the converter is about the full well
    assert file.noise.electrons_at_one == pytest.approx(file.noise.full_well_e, rel=0.01)


def test_there_are_packaged_sensors_of_both_kinds() -> None:
    assert {load_sensor(p).kind for p in PACKAGED} == {"instance", "virtual"}


# --- TOML


@pytest.mark.parametrize("path", PACKAGED, ids=lambda p: p.stem)
def test_packaged_sensors_come_back_from_their_text(path: Path, tmp_path: Path) -> None:
    file = load_sensor(path)
    write_text(tmp_path / "copy.toml", sensor_to_toml(file, ("what it is", "and from where")))
    assert (tmp_path / "copy.toml").read_text(encoding="utf-8").startswith("# what it is\n# and from where\n")
    assert load_sensor(tmp_path / "copy.toml") == file


def _number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.one_of(st.just(low), st.floats(low, high, allow_subnormal=False))


FIGURE = {
    name: _number(0.0, high)
    for name, high in {
        "read_e": 1e3,
        "dark_e_s": 1e5,
        "exposure_s": 1e3,
        "row_e": 1e3,
        "dsnu_e": 1e3,
        "prnu": 1.0,
        "crosstalk": 0.2,
    }.items()
}
MODELS = st.integers(1, 16).flatmap(
    lambda bits: st.builds(
        NoiseModel,
        bits=st.just(bits),
        gain_dn_e=st.floats(1e-6, 1e3),
        full_well_e=st.floats(1e-3, 1e9),
        black_dn=st.floats(0.0, 2.0**bits - 1.5),
        **FIGURE,
    )
)
LENSES: tuple[tuple[Lens, int], ...] = (
    ("brown_conrady", 0),
    ("brown_conrady", 4),
    ("brown_conrady", 5),
    ("brown_conrady", 8),
    ("kannala_brandt", 0),
    ("kannala_brandt", 4),
)
CAMERAS = st.sampled_from(LENSES).flatmap(
    lambda of: st.builds(
        Camera,
        st.integers(1, 9999),
        st.integers(1, 9999),
        *[st.floats(0.1, 1e5)] * 2,
        *[st.floats(-1e5, 1e5)] * 2,
        st.tuples(*[st.floats(-2.0, 2.0)] * of[1]),
        st.just(of[0]),
    )
)


@settings(max_examples=80, deadline=None)
@given(
    noise=MODELS,
    camera=st.none() | CAMERAS,
    ratio=st.just(math.inf) | st.floats(1.01, 1e9),
    angle=st.floats(-360, 360),
    exposure=st.floats(1e-3, 1e3),
    alignment=st.sampled_from(["msb", "lsb"]),
    offset=st.tuples(st.integers(0, 9), st.integers(0, 9)),
    words=st.text(st.characters(codec="utf-8"), max_size=40),
    turn=st.none() | st.floats(-3.0, 3.0),
)
def test_any_sensor_comes_back_from_its_text(
    tmp_path_factory: pytest.TempPathFactory,
    noise: NoiseModel,
    camera: Camera | None,
    ratio: float,
    angle: float,
    exposure: float,
    alignment: Any,
    offset: tuple[int, int],
    words: str,
    turn: float | None,
) -> None:
    place = None
    if turn is not None:
        c, s = math.cos(turn), math.sin(turn)
        place = ((c, -s, 0.0, turn), (s, c, 0.0, 0.1), (0.0, 0.0, 1.0, -2.0), (0.0, 0.0, 0.0, 1.0))
    polarizer = Polarizer(angle_deg=angle, extinction_ratio=ratio, throughput=0.9)
    file = SensorFile(
        name="any-1",
        description=words,
        measured=("one", "two.toml"),
        camera=camera,
        camera_to_reference=place,
        mosaic=((0, 1), (1, 2)),
        mosaic_offset=offset,
        channels=(
            Channel(label="a", response=Response(nm=(400.0, 500.5, 601.0), value=(0.0, exposure, 0.25)), polarizer=polarizer),
            Channel(label="b", response=Response(centre_nm=500.0 + angle, fwhm_nm=exposure, peak=2.0), polarizer=polarizer),
            Channel(label="c", of="rgb.G", polarizer=polarizer),
        ),
        alignment=alignment,
        exposure=exposure,
        off_axis="lens",
        supersampling=3,
        noise=noise,
    )
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_text(sensor_to_toml(file), encoding="utf-8")
    assert load_sensor(path) == file


def test_what_has_its_default_is_left_out() -> None:
    text = sensor_to_toml(SensorFile(name="cam", instance_of="rgb", noise=NOISE))
    assert text == 'name = "cam"\ninstance_of = "rgb"\n\n[noise]\nbits = 12\ngain_dn_e = 0.4\nfull_well_e = 10500.0\n'


# --- responses


def test_tables_are_linear_and_end_with_their_entries() -> None:
    response = Response(nm=(400.0, 500.0, 700.0), value=(0.2, 1.0, 0.5))
    at = np.array([300.0, 399.9, 400.0, 450.0, 500.0, 600.0, 700.0, 700.1, 2000.0])
    np.testing.assert_allclose(response.at(at), [0, 0, 0.2, 0.6, 1.0, 0.75, 0.5, 0, 0], atol=1e-15)
    assert response.range_nm() == (400.0, 700.0)


@given(centre=st.floats(200, 2000), width=st.floats(0.5, 90), peak=st.floats(0.01, 100))
def test_a_gaussian_has_half_its_peak_at_half_its_width(centre: float, width: float, peak: float) -> None:
    response = Response(centre_nm=centre, fwhm_nm=width, peak=peak)
    np.testing.assert_allclose(response.at(centre + 0.5 * width * np.array([-1, 0, 1])), peak * np.array([0.5, 1, 0.5]), rtol=1e-9)
    low, high = response.range_nm()
    # ∫ = peak · FWHM · √(π / (4 ln 2)), next to all of it within the range
    area = peak * width * math.sqrt(math.pi / (4 * math.log(2)))
    assert quad(lambda nm: float(response.at(np.array([nm]))[0]), low, high)[0] == pytest.approx(area, rel=1e-5)


# --- numbers of files


@pytest.mark.parametrize("alignment", ["msb", "lsb"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("black", [0.0, 16.0])
def test_light_of_the_integers_in_files(bits: int, alignment: Any, black: float) -> None:
    """Reader and writer: light → number of the converter → integer of the file → value of 1.0 = full scale → light."""
    file = SensorFile(name="cam", instance_of="rgb", alignment=alignment, noise=NoiseModel(bits, 0.5, 1e4, black_dn=black))
    stored = 8 if bits == 8 else 16
    assert file.file_bits == stored and file.shift == (stored - bits if alignment == "msb" else 0)
    numbers = np.arange(2**bits)
    integers = numbers * 2**file.shift
    assert integers.max() < 2**stored
    values = integers / (2**stored - 1)
    np.testing.assert_allclose(values * file.dn_at_one, numbers, atol=1e-9)
    light = file.light_of(values)
    np.testing.assert_allclose(light, (numbers - black) / (2**bits - 1 - black), atol=1e-12)
    assert light[int(black)] == pytest.approx(0.0, abs=1e-12) and light[-1] == pytest.approx(1.0)
    np.testing.assert_allclose(light * file.noise.electrons_at_one * 0.5 + black, numbers, atol=1e-8)


@pytest.mark.parametrize("bits, stored", [(1, 8), (7, 8), (9, 16), (11, 16)])
def test_other_depths_are_stored_in_the_next_integers(bits: int, stored: int) -> None:
    file = SensorFile(name="cam", instance_of="rgb", noise=NoiseModel(bits, 0.5, 1e4))
    assert file.file_bits == stored and file.shift == stored - bits
    assert ((2**bits - 1) << file.shift) / (2**stored - 1) * file.dn_at_one == pytest.approx(2**bits - 1)


# --- refusals


def test_the_file_that_the_others_break_is_good(tmp_path: Path) -> None:
    assert load_sensor(_write(tmp_path, end=CAMERA)).camera == Camera(4, 3, 5.0, 5.0, 1.5, 1.0)
    table = "response = { nm = [400.0, 500.0], value = [1.0, 0.5] }"
    assert load_sensor(_write(tmp_path, 'measured = ["m"]', table)).kind == "virtual"


@pytest.mark.parametrize(
    "key, where",
    [
        ("colour", {"top": "colour = 3"}),
        ("noise.sigma", {"noise": FIGURES + "\nsigma = 3"}),
        ("camera.focal", {"end": CAMERA + "focal = 3.0"}),
        ("channels.0.wavelength", {"channel": 'of = "rgb.R"\nwavelength = 500.0'}),
        ("channels.0.polarizer.colour", {"channel": 'of = "rgb.R"\npolarizer = { angle_deg = 0.0, colour = 1 }'}),
        ("channels.0.response.width", {"top": 'measured = ["m"]', "channel": "response = { centre_nm = 500.0, fwhm_nm = 9.0, width = 9 }"}),
    ],
)
def test_unknown_keys_are_refused(tmp_path: Path, key: str, where: dict[str, str]) -> None:
    assert _refusal(_write(tmp_path, **where)).startswith(f"{key}: ")


RIGID = "camera_to_reference = [[{}, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, {}]]"


@pytest.mark.parametrize(
    "key, where",
    [
        ("mosaic: holds the channels [0, 2]", {"top": "mosaic = [[0, 2]]"}),
        ("mosaic: holds the channels [-1]", {"top": "mosaic = [[-1]]"}),
        ("mosaic: expected rows of one length", {"top": "mosaic = [[0], [0, 0]]"}),
        ("mosaic: expected rows of one length", {"top": "mosaic = []"}),
        ("mosaic: 2 channels, but 'channels' has 1", {"top": "mosaic = [[0, 1]]"}),
        ("mosaic_offset", {"top": "mosaic = [[0]]\nmosaic_offset = [0, -1]"}),
        ("channels: a: expected one of 'of' and 'response'", {"channel": ""}),
        (
            "channels: a: expected one of 'of' and 'response'",
            {"top": 'measured = ["m"]', "channel": 'of = "rgb.R"\nresponse = { centre_nm = 500.0, fwhm_nm = 9.0 }'},
        ),
        ("measured", {"channel": "response = { centre_nm = 500.0, fwhm_nm = 9.0 }"}),
        ("channels: the labels are a, a", {"channel": 'of = "rgb.R"\n[[channels]]\nlabel = "a"\nof = "rgb.G"'}),
        ("channels: some have a polarizer", {"channel": 'of = "rgb.R"\n[[channels]]\nlabel = "b"\npolarizer = { angle_deg = 0.0 }'}),
        ("channels.0.polarizer.extinction_ratio", {"channel": "polarizer = { angle_deg = 0.0, extinction_ratio = 1.0 }"}),
        ("channels.0.polarizer.throughput", {"channel": "polarizer = { angle_deg = 0.0, throughput = 1.1 }"}),
        ("channels.1.label", {"channel": 'of = "rgb.R"\n[[channels]]\nof = "x.y"\nlabel = ""'}),
        ("camera_to_reference: expected a rigid", {"top": RIGID.format("2.0", "1.0")}),
        ("camera_to_reference: expected a rigid", {"top": RIGID.format("-1.0", "1.0")}),
        ("camera_to_reference: expected a rigid", {"top": RIGID.format("1.0", "2.0")}),
        ("camera_to_reference.0.0", {"top": RIGID.format("nan", "1.0")}),
        ("camera_to_reference: expected a rigid", {"top": "camera_to_reference = [[1.0, 0.0], [0.0]]"}),
        ("description", {"top": 'instance_of = "rgb"\ndescription = 3'}),
        ("exposure", {"top": "exposure = 0.0"}),
        ("psf_sigma_px", {"top": "psf_sigma_px = 21.0"}),
        ("supersampling", {"top": "supersampling = 0"}),
        ("vignetting", {"top": "vignetting = [0.1, 0.2]"}),
        ("off_axis", {"top": 'off_axis = "tilted"'}),
        ("alignment", {"top": 'alignment = "middle"'}),
        ("noise: ", {"noise": FIGURES + "\nread_e = -1.0"}),
        ("noise: ", {"noise": FIGURES + "\ncrosstalk = 0.21"}),
        ("noise.bits", {"noise": "gain_dn_e = 0.4\nfull_well_e = 1e4"}),
        ("camera: ", {"end": CAMERA.replace("fx = 5.0", "fx = -5.0")}),
        ("camera: ", {"end": CAMERA + "distortion = [0.1]"}),
        ("camera.fx", {"end": "[camera]\nwidth = 4\nheight = 3"}),
    ],
)
def test_what_cannot_be_is_refused_by_its_key(tmp_path: Path, key: str, where: dict[str, str]) -> None:
    assert _refusal(_write(tmp_path, **where)).startswith(key)


@pytest.mark.parametrize(
    "response",
    [
        "{ nm = [400.0, 500.0], value = [1.0] }",
        "{ nm = [500.0, 400.0], value = [1.0, 1.0] }",
        "{ nm = [400.0, 400.0], value = [1.0, 1.0] }",
        "{ nm = [400.0], value = [1.0] }",
        "{ nm = [400.0, 500.0] }",
        "{ nm = [400.0, 500.0], value = [1.0, -0.1] }",
        "{ centre_nm = 500.0 }",
        "{ fwhm_nm = 50.0 }",
        "{ centre_nm = 500.0, fwhm_nm = 0.0 }",
        "{ centre_nm = 500.0, fwhm_nm = 9.0, nm = [400.0, 500.0], value = [1.0, 1.0] }",
        "{ peak = 1.0 }",
    ],
)
def test_responses_that_cannot_be_are_refused(tmp_path: Path, response: str) -> None:
    assert _refusal(_write(tmp_path, 'measured = ["m"]', f"response = {response}")).startswith("channels.0.response")


@pytest.mark.parametrize(
    "response", ["{ nm = [400.0, 500.0], value = [0.0, 0.0] }", "{ nm = [400.0, 500.0], value = [1.0, 1.0], peak = 3.0 }"]
)
def test_responses_to_nothing_and_peaks_of_tables_are_refused(tmp_path: Path, response: str) -> None:
    """The first has no weights, the second's peak would be without effect."""
    assert _refusal(_write(tmp_path, 'measured = ["m"]', f"response = {response}")).startswith("channels.0.response")


@pytest.mark.parametrize(
    "key, where",
    [
        ("exposure", {"top": "exposure = inf"}),
        ("vignetting", {"top": "vignetting = [nan, 0.0, 0.0]"}),
        ("vignetting", {"top": "vignetting = [inf, 0.0, 0.0]"}),
        ("polarizer_angle_sd_deg", {"top": "polarizer_angle_sd_deg = inf"}),
        ("channels.0.polarizer.angle_deg", {"channel": "polarizer = { angle_deg = nan }"}),
        ("channels.0.response", {"top": 'measured = ["m"]', "channel": "response = { centre_nm = 500.0, fwhm_nm = inf }"}),
        ("channels.0.response", {"top": 'measured = ["m"]', "channel": "response = { nm = [400.0, 500.0], value = [1.0, inf] }"}),
        ("noise", {"noise": FIGURES + "\nread_e = inf"}),
        ("noise", {"noise": FIGURES.replace("0.4", "inf")}),
        ("noise", {"noise": FIGURES + "\nprnu = nan"}),
    ],
)
def test_numbers_that_are_none_are_refused(tmp_path: Path, key: str, where: dict[str, str]) -> None:
    """TOML has inf and nan; frames of them would be white, black or NaN."""
    assert _refusal(_write(tmp_path, **where)).startswith(key)


def test_a_key_is_named_once(tmp_path: Path) -> None:
    assert not _refusal(_write(tmp_path, noise=FIGURES + "\nread_e = -1.0")).startswith("noise: noise:")


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "cam.toml"
    assert "could not be read" in _refusal(path)
    assert "could not be read" in _refusal(tmp_path)
    path.write_text("name = \n")
    assert "line 1" in _refusal(path)
    path.write_bytes(b'name = "\xff"\n')
    assert "not valid TOML" in _refusal(path)
    path.write_text(f'instance_of = "rgb"\n[noise]\n{FIGURES}\n')
    assert _refusal(path).startswith("name: ")
    path.write_text(f'name = "a b"\ninstance_of = "rgb"\n[noise]\n{FIGURES}\n')
    assert _refusal(path).startswith("name: ")
    path.write_text(f'name = "cam"\n[noise]\n{FIGURES}\n')
    assert _refusal(path).startswith("channels: none")
    path.write_text('name = "cam"\ninstance_of = "rgb"\n')
    assert _refusal(path).startswith("noise: ")


# --- finding


def test_the_file_beside_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    beside, here = tmp_path / "beside", tmp_path / "here"
    for folder in (beside, here):
        folder.mkdir()
        (folder / "bayer_rgb.toml").write_text("")
    monkeypatch.chdir(here)
    packaged = data_folder("recipes") / "sensors" / "bayer_rgb.toml"
    assert find_sensor_file("bayer_rgb.toml", beside) == beside / "bayer_rgb.toml"
    assert find_sensor_file("bayer_rgb.toml").resolve() == here / "bayer_rgb.toml"
    assert find_sensor_file("bayer_rgb", beside) == packaged  # a name is a packaged sensor's
    (beside / "bayer_rgb.toml").unlink()
    assert find_sensor_file("bayer_rgb.toml", beside).resolve() == here / "bayer_rgb.toml"
    (here / "bayer_rgb.toml").unlink()
    assert find_sensor_file("bayer_rgb.toml", beside) == packaged
    assert find_sensor_file(str(packaged)) == packaged == find_sensor_file(str(packaged), beside)


@pytest.mark.parametrize("name", ["nothing", "nothing.toml", "folder/bayer_rgb", "folder/bayer_rgb.toml", ""])
def test_an_unknown_sensor_lists_the_known_ones(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        find_sensor_file(name, tmp_path)
    said = str(refused.value)
    assert repr(name) in said and all(p.stem in said for p in PACKAGED)
    assert "\n" not in said and said.endswith(".")
