"""Random scenes for a prior: paints, lamps and bookkeeping, and (oracle) that a rendered white reads what the files say."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from scipy import constants, stats

from mmsynth.scene.load import load_scene
from mmsynth.sensors.camera import unproject
from mmsynth.sensors.mosaic import channel_map

EXAMPLES = Path(__file__).parents[2] / "examples"
FAMILIES = ("pigment", "warm", "cool", "black_dye", "neutral", "wood", "leaf", "skin", "narrow_bands")


@pytest.fixture(scope="module")
def script() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        return importlib.import_module("render_prior_scenes")


def bands(script: ModuleType, spectrum: np.ndarray) -> np.ndarray:
    """(C,) mean of a spectrum, weighted with each response of the multispectral camera's filters."""
    weights = script.responses()["multispectral"][:8]
    return weights @ spectrum / weights.sum(1)


@pytest.mark.parametrize("family", FAMILIES)
def test_reflectances_of_a_family(script: ModuleType, family: str) -> None:
    rng = np.random.default_rng(1)
    made = np.stack([getattr(script, family)(rng) for _ in range(100)])
    assert made.shape == (100, len(script.NM)) and made.min() >= 0 and made.max() <= 1
    assert np.ptp(made, axis=0).max() > 0.1, "no two the same"


def test_visible_colour_leaves_the_infrared_open(script: ModuleType) -> None:
    rng = np.random.default_rng(2)
    made = np.stack([script.paint(rng) for _ in range(2000)])
    assert made.min() >= 0.005 and made.max() <= 0.97
    colour = np.array([bands(script, p) for p in made])
    blue = made[(colour[:, 6] > 1.5 * colour[:, 2])]  # 464 nm over 611 nm
    infrared = blue[:, script.NM > 800].mean(1)
    assert len(blue) > 100 and np.mean(infrared < 0.25) > 0.1 and np.mean(infrared > 0.5) > 0.2


@pytest.mark.parametrize("seed", range(20))
def test_pairs_of_paints(script: ModuleType, seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, weights = script.paint(rng), script.responses()["rgb"] * script.lamp_spectrum(rng)[1]
    other = script.metamer(rng, first, weights)
    assert other.min() >= 0 and other.max() <= 1
    assert np.allclose(weights @ other, weights @ first, rtol=1e-9) and np.abs(other - first).max() > 1e-3
    twin = script.infrared_twin(rng, first)
    assert np.allclose(twin[script.NM <= 640], first[script.NM <= 640], atol=1e-3) and twin.min() >= 0 and twin.max() <= 1


def test_metals_reflect_as_metals(script: ModuleType) -> None:
    rng = np.random.default_rng(3)
    for _ in range(50):
        eta, k = script.metal(rng)
        reflectance = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)  # Fresnel, at normal incidence
        assert eta.min() > 0 and reflectance.min() > 0.25 and reflectance.max() < 1 and reflectance[-1] > 0.45


def test_spectra_of_lamps(script: ModuleType) -> None:
    rng = np.random.default_rng(4)
    kinds: dict[str, int] = {}
    for _ in range(100):
        name, curve = script.lamp_spectrum(rng)
        kinds[name.split()[0]] = kinds.get(name.split()[0], 0) + 1
        assert curve.min() > 0 and curve[script.NM <= 700].mean() == pytest.approx(1)
        if name.startswith("blackbody"):
            x = constants.h * constants.c / (script.NM * 1e-9 * constants.k * float(name.split()[1]))
            planck = x**5 / np.expm1(x)
            assert np.allclose(curve / curve[0], planck / planck[0], rtol=1e-3)
    assert kinds["blackbody"] > 60 and set(kinds) == {"blackbody", "LED", "fluorescent"}


def test_radiance_of_a_lamp(script: ModuleType) -> None:
    """A small lamp far away: irradiance is radiance × area × cosine / distance²."""
    position = 5.0 * np.array([np.cos(1.0), 0.0, np.sin(1.0)])
    lamp = script.Lamp("LED", np.ones_like(script.NM), 0.4, tuple(position), 0.05)
    assert np.allclose(lamp.radiance() * 0.1**2 * np.sin(1.0) / 25 / np.pi, 0.4, rtol=1e-3)


def test_a_scene_is_the_same_again(script: ModuleType) -> None:
    def numbers(seed: int, index: int) -> np.ndarray:
        made = script.design(seed, index)
        parts = [v.ravel() for t in made.things for v in (t.surface.vertices, t.spectra, np.array([t.roughness, t.index]))]
        poses = script.rig_poses(np.random.default_rng([seed, index, 1]))
        return np.concatenate([*parts, made.light(), *[np.ravel(p) for p in poses]])

    first = numbers(3, 1)
    assert np.array_equal(first, numbers(3, 1))
    for other in (numbers(3, 2), numbers(4, 1)):
        assert other.shape != first.shape or not np.allclose(other, first)


@pytest.mark.parametrize("index", range(12))
def test_things_stand_apart_on_the_table(script: ModuleType, index: int) -> None:
    made = script.design(5, index)
    assert made.things[0].label == "table" and len(set(made.labels())) == len(made.labels())
    standing = [t for t in made.things[1:] if t.label != "room"]
    assert 3 <= len(standing) <= 8 and 1 <= sum(lamp.position is not None for lamp in made.lamps) <= 5
    assert sum(lamp.share for lamp in made.lamps) == pytest.approx(1) and all(lamp.share > 0 for lamp in made.lamps)
    circles = []
    for t in standing:
        points = t.surface.vertices
        assert points[:, 2].min() == pytest.approx(0, abs=1e-9)
        assert np.linalg.norm(points - [0, 0, 0.105], axis=-1).max() < 0.27, "in the region of interest"
        assert np.linalg.norm(points[:, :2], axis=-1).max() < script.TABLE_RADIUS
        circles.append(cv2.minEnclosingCircle(points[:, :2].astype(np.float32)))
    for i, ((ax, ay), ar) in enumerate(circles):
        for (bx, by), br in circles[:i]:
            assert np.hypot(ax - bx, ay - by) > ar + br
    for t in made.things:
        assert t.spectra.shape[1:] == script.NM.shape and np.isfinite(t.surface.normals).all()


def test_a_smaller_picture_has_the_same_field_of_view(script: ModuleType) -> None:
    for full, half in zip(script.rig(1.0), script.rig(0.5), strict=True):
        middle = np.array([full.camera.width / 3, full.camera.height / 4])
        rays = [unproject(s * (middle + 0.5) - 0.5, sensor.camera)[0] for s, sensor in ((1.0, full), (0.5, half))]
        assert np.allclose(*rays, atol=1e-12) and abs(half.camera.width - full.camera.width / 2) <= 0.5


def test_a_reader_finds_the_white_of_each_channel(script: ModuleType) -> None:
    made, sensors = script.design(6, 0), script.rig(0.5)
    gains = {s.name: 0.01 * (i + 1) for i, s in enumerate(sensors)}
    content: dict[str, Any] = json.loads(json.dumps(script.describe(made, sensors, gains, dict.fromkeys(gains, 0.0))))
    nm, light = np.array(content["wavelengths_nm"]), np.array(content["light"])
    assert np.allclose(light, sum(lamp["share"] * np.array(lamp["spectrum"]) for lamp in content["lamps"]), atol=1e-5)
    assert light[nm <= 700].mean() == pytest.approx(1, abs=1e-5)
    for name, entry in content["sensors"].items():
        step = nm[1] - nm[0]
        rows = np.array(entry["response"]) * light
        assert np.allclose(entry["white"], gains[name] * step * (rows.sum(1) - (rows[:, 0] + rows[:, -1]) / 2), rtol=1e-4)
    # Gaussians of the packaged file, inside the range: what a flat light of radiance 1 gives is their area
    area = script.integrals(np.ones_like(nm))["multispectral"][1:6]
    assert np.allclose(area, 40 / (2 * np.sqrt(2 * np.log(2))) / stats.norm.pdf(0), rtol=1e-3)


def test_gain_exposes_the_bright_photosites(script: ModuleType) -> None:
    mono, pol = (next(s for s in script.rig(0.5) if s.name == name) for name in ("mono", "polarization"))
    image = np.random.default_rng(0).random((50, 50, 1))
    assert np.percentile(script.gain_of(mono, image) * image, 99.5) == pytest.approx(0.8, rel=1e-4)
    # fully polarized light passes one of the analysers whole
    stokes = image * np.array([1.0, 0.0, -1.0])
    assert script.gain_of(pol, stokes) == pytest.approx(script.gain_of(mono, image))


@pytest.fixture(scope="module")
def mitsuba(script: ModuleType) -> Any:
    pytest.importorskip("mitsuba")
    try:
        return script.example.load_mitsuba()
    except ImportError as error:  # no LLVM
        pytest.skip(str(error))


@pytest.mark.oracle
@pytest.mark.parametrize("index", [0, 2])
def test_a_rendered_paint_reads_its_reflectance_times_white(script: ModuleType, mitsuba: Any, index: int) -> None:
    made = script.design(7, index)
    paint = script.narrow_bands(np.random.default_rng(0))
    table = replace(made.things[0], material="matte", spectra=paint[None], pattern=None)
    # squares alone: they hide a little of the light from everywhere
    empty = script.Design([table], [lamp for lamp in made.lamps if lamp.position is not None])
    scene, _ = script.build_scene(mitsuba, empty)
    pose = script.example.look_at(np.array([0.3, 0.1, 0.6]), np.zeros(3))
    camera = script.example.Camera(8, 8, 4000.0, 4000.0, 3.5, 3.5)
    seen = script.render_all(mitsuba, scene, camera, pose, empty.light(), 1024, 1)
    for name, expected in script.integrals(empty.light() * paint).items():
        value = seen[name][..., :1] if name == "polarization" else seen[name]
        assert np.allclose(value.mean((0, 1)), expected, rtol=0.01)
    assert np.abs(seen["polarization"][..., 1:].mean((0, 1))).max() < 0.01 * seen["polarization"][..., 0].mean(), "matte does not polarize"


@pytest.mark.oracle
def test_a_rendered_scene_opens(script: ModuleType, mitsuba: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr("sys.argv", ["script", str(tmp_path), "--scenes", "1", "--seed", "8", "--scale", "0.4", "--spp", "16"])
    script.main()
    folder = tmp_path / "8_0000"
    assert [path.name for path in tmp_path.iterdir()] == ["8_0000"]
    scene = load_scene(folder)
    assert len(scene.sensors) == 5 and tuple(scene.split.test) == script.TEST_VIEWS and not scene.problems
    content, gains = (json.loads((folder / name).read_text()) for name in ("sensors.json", "exposure.json"))
    meta = json.loads((folder / "meta_data.json").read_text())["modalities"]
    labels = json.loads((folder / "gt/labels.json").read_text())
    ratios = []
    for view in range(script.VIEWS):
        aligned, geometry = (np.load(folder / f"gt/{name}/{view:04d}.npz") for name in ("aligned", "geometry"))
        assert {str(label) for label in np.unique(geometry["label"])} <= set(labels) and geometry["in_roi"].mean() > 0.2
        for name in gains:
            assert aligned[name].shape[:2] == geometry["label"].shape and np.isfinite(aligned[name]).all()
        raw = cv2.imread(str(folder / f"modalities/rgb/{view:04d}.png"), cv2.IMREAD_UNCHANGED) / 65535
        own = channel_map(np.array(meta["rgb"]["mosaick_pattern"]), *raw.shape)
        light = np.take_along_axis(aligned["rgb"].astype(float), own[..., None], 2)[..., 0]
        use = geometry["in_roi"] & (light > 0.05)
        ratios.append(raw[use] / light[use])
    assert np.median(np.concatenate(ratios)) == pytest.approx(1, abs=0.03), "frames and truth have one unit"
    assert gains == {name: entry["gain"] for name, entry in content["sensors"].items()}
    before = (folder / "sensors.json").stat().st_mtime_ns
    capsys.readouterr()
    script.main()
    assert "there" in capsys.readouterr().out and (folder / "sensors.json").stat().st_mtime_ns == before


@pytest.mark.oracle
def test_lamps_keep_their_order(script: ModuleType, mitsuba: Any) -> None:
    """Which lamp a random number chooses depends on it."""
    made = script.design(8, 0)
    orders = {tuple(shape.id() for shape in script.build_scene(mitsuba, made)[0].shapes()) for _ in range(30)}
    assert len(orders) == 1
