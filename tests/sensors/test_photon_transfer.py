"""The photon transfer curve: figures that noise was made with come back, within the deviations that are stated."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from mmsynth.errors import InputError
from mmsynth.sensors.mosaic import channel_map
from mmsynth.sensors.noise import NoiseModel, record
from mmsynth.sensors.photon_transfer import PhotonTransfer, photon_transfer, photon_transfer_of_frames

CAMERA = NoiseModel(bits=12, gain_dn_e=0.4, full_well_e=10500.0, read_e=5.0, black_dn=64.0)
NONE = np.array([[0]])
RGGB = np.array([[0, 1], [1, 2]])
MULTISPECTRAL = np.array([[4, 5, 6], [2, 1, 0], [3, 8, 7]])


def _model(prnu: float = 0.0, black_dn: float = 64.0, read_e: float = 5.0) -> NoiseModel:
    return NoiseModel(12, 0.4, 10500.0, read_e, black_dn, prnu=prnu)


def _values(model: NoiseModel, seed: int, wrong: float = 0.0, count: int = 50_000) -> tuple[np.ndarray, np.ndarray]:
    """Raw and expected values of light from none to full scale, more of it dark; a share of them is far from the expectation."""
    random = np.random.default_rng(seed)
    light = random.random((1, 200, count // 200)) ** 2
    raw = record(torch.from_numpy(light), model, [0], "cam", seed=seed).numpy().ravel()
    outliers = random.random(raw.size) < wrong
    raw[outliers] = np.clip(raw[outliers] + random.normal(0, 400, outliers.sum()), 0, model.white_dn)
    return raw, (model.black_dn + light * (model.white_dn - model.black_dn)).ravel()


def _require_within_deviations(found: PhotonTransfer, model: NoiseModel) -> None:
    assert abs(found.gain_dn_e - model.gain_dn_e) < 4 * found.gain_sd
    assert abs(found.read_e - model.read_e) < 4 * found.read_sd
    assert abs(found.prnu - model.prnu) < 4 * found.prnu_sd


# --- values and what they are expected to be


@pytest.mark.parametrize("prnu", [0.0, 0.01])
@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_the_curve_gives_the_figures_back(prnu: float, wrong: float) -> None:
    """Also when some pixels are far from what they were expected to be, as at edges of a field."""
    model = NoiseModel(12, 0.4, 10500.0, 5.0, 64.0, prnu=prnu)
    random = np.random.default_rng(0)
    light = torch.from_numpy(random.random((4, 200, 250)) ** 2)
    raw = record(light, model, range(4), "cam").numpy().ravel()
    expected = (64 + light.numpy() * (4095 - 64)).ravel()
    outliers = random.random(len(raw)) < wrong
    raw[outliers] = np.clip(raw[outliers] + random.normal(0, 400, outliers.sum()), 0, 4095)
    found = photon_transfer(raw, expected, 12, 64.0)
    loose = 1.0 if wrong == 0 else 2.5
    assert found.gain_dn_e == pytest.approx(0.4, rel=0.02 * loose)
    assert found.read_e == pytest.approx(5.0, rel=0.1 * loose)
    assert found.prnu == pytest.approx(prnu, abs=0.0035)
    if wrong == 0:
        assert abs(found.gain_dn_e - 0.4) < 4 * found.gain_sd and 0 < found.gain_sd < 0.01
        assert abs(found.read_e - 5.0) < 4 * found.read_sd and 0 < found.read_sd < 0.5


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("black_dn", [0.0, 64.0])
@pytest.mark.parametrize("prnu", [0.0, 0.01])
def test_figures_come_back_within_their_deviations(prnu: float, black_dn: float, seed: int) -> None:
    """Black at 0 as well, where half of what is dark is cut off."""
    model = _model(prnu, black_dn)
    raw, expected = _values(model, seed)
    assert ((raw == 0).mean() > 0.005) == (black_dn == 0)
    found = photon_transfer(raw, expected, 12, black_dn)
    _require_within_deviations(found, model)
    assert 0 < found.gain_sd < 0.02 * 0.4 and 0 < found.read_sd < 0.25 and 0 < found.prnu_sd < 0.004


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("black_dn", [0.0, 64.0])
@pytest.mark.parametrize("prnu", [0.0, 0.01])
def test_figures_come_back_within_their_deviations_in_spite_of_outliers(prnu: float, black_dn: float, seed: int) -> None:
    model = _model(prnu, black_dn)
    _require_within_deviations(photon_transfer(*_values(model, seed, 0.05), 12, black_dn), model)


def test_deviations_are_those_that_repetitions_have() -> None:
    """Over 24 sensors the figures spread as each of them says; a spread of n numbers is known to 1 / √(2 n)."""
    found = [photon_transfer(*_values(CAMERA, seed, count=10_000), 12, 64.0) for seed in range(24)]
    z = np.array([[(f.gain_dn_e - 0.4) / f.gain_sd, (f.read_e - 5.0) / f.read_sd] for f in found])
    assert (np.abs(z.mean(0)) < 4 / math.sqrt(24)).all()
    assert (np.abs(z.std(0, ddof=1) - 1) < 4 / math.sqrt(2 * 23)).all()


def test_the_curve_is_the_photon_transfer_equation() -> None:
    model = _model(0.01)
    found = photon_transfer(*_values(model, 0), 12, 64.0)
    above = found.mean_dn - 64
    assert len(above) == 32 and (np.diff(above) > 0).all()
    # medians of the squares of 1560 values: the deviation of each is 2.33 / √n of it (1 / (2 √q φ(√q)), q = 0.455)
    expected = 0.16 * 25 + 1 / 12 + 0.4 * above + (0.01 * above) ** 2
    inner = slice(1, None)  # across the darkest bin and beside the black level the variance changes much
    assert (np.abs(found.variance_dn2 / expected - 1)[inner] < 4 * 2.34 / math.sqrt(1562)).all()


def test_values_that_tell_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="usable values"):
        photon_transfer(np.full(20, 100.0), np.full(20, 100.0), 12)
    flat = record(torch.full((1, 200, 250), 0.3, dtype=torch.float64), CAMERA, [0], "cam").numpy().ravel()
    with pytest.raises(InputError, match="no range of light"):
        photon_transfer(flat, np.full(50000, 64 + 0.3 * 4031), 12, 64.0)
    random = np.random.default_rng(0)
    bright = random.uniform(200, 3000, 50000)
    with pytest.raises(InputError, match="does not grow with light"):
        photon_transfer(bright + 5 * np.sqrt(3200 - bright) * random.normal(size=50000) / 10, bright, 12)


def test_values_without_a_sense_are_left_out() -> None:
    raw, expected = _values(CAMERA, 0, count=10_000)
    junk = np.array([np.nan, np.inf, -5.0, 64.0, 4095.0, 9000.0])
    with_junk = photon_transfer(np.concatenate([raw, np.full(6, 100.0)]), np.concatenate([expected, junk]), 12, 64.0)
    alone = photon_transfer(raw, expected, 12, 64.0)
    assert with_junk.gain_dn_e == alone.gain_dn_e and with_junk.read_e == alone.read_e


# --- frames and renderings


def _light(seed: int, channels: int, texture: str, size: tuple[int, int] = (200, 260)) -> np.ndarray:
    """(H, W, C): smooth light from 0.01 to 0.7, fine texture in half of the picture, in bright half of it, or nowhere."""
    random = np.random.default_rng(seed)
    base = gaussian_filter(random.random(size), 25)
    base = (base - base.min()) / np.ptp(base)
    fine = (gaussian_filter(random.random(size), 1) - 0.5) * 3
    by = gaussian_filter(random.random(size), 15) if texture == "anywhere" else base
    fine = fine * ((by > np.median(by)) & (texture != "nowhere"))
    light = 0.01 + 0.7 * base**2 * (1 + 0.3 * fine)
    return np.stack([light * share for share in np.linspace(1.0, 0.8, channels)], -1)


def _frames(
    model: NoiseModel, count: int, seed: int, texture: str, pattern: np.ndarray = NONE, rough: bool = True
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Raw frames and what a model says of them; a rough one is blurred and 2 % too bright."""
    out = []
    for i in range(count):
        light = _light(100 * seed + i, int(pattern.max()) + 1, texture)
        index = channel_map(pattern, *light.shape[:2])[..., None]
        raw = record(torch.from_numpy(np.take_along_axis(light, index, -1)[None, ..., 0]), model, [i], "cam", seed=seed)[0].numpy()
        rendered = gaussian_filter(light, (1, 1, 0)) * 1.02 if rough else light
        out.append((raw, model.black_dn + rendered * (model.white_dn - model.black_dn)))
    return out


@pytest.mark.parametrize("prnu", [0.0, 0.01])
def test_a_rough_model_of_textured_frames_is_enough(prnu: float) -> None:
    found = photon_transfer_of_frames(_frames(_model(prnu), 8 if prnu else 4, 0, "anywhere"), NONE, 12, 64.0)
    assert found.gain_dn_e == pytest.approx(0.4, rel=0.1)
    assert found.prnu == pytest.approx(prnu, rel=0.05)
    if prnu == 0:
        assert 0 < found.prnu_sd < 0.005


@pytest.mark.parametrize("pattern", [RGGB, MULTISPECTRAL], ids=["2x2", "3x3"])
def test_photosites_of_a_mosaic_are_enough(pattern: np.ndarray) -> None:
    found = photon_transfer_of_frames(_frames(_model(), 2, 1, "anywhere", pattern), pattern, 12, 64.0)
    assert found.gain_dn_e == pytest.approx(0.4, rel=0.1) and found.prnu == 0.0
    assert (np.diff(found.mean_dn) > 0).all()


@pytest.mark.parametrize("texture", ["anywhere", "bright"])
@pytest.mark.parametrize("seed", [0, 1])
def test_texture_that_the_model_does_not_see_leads_off_no_farther_than_is_said(seed: int, texture: str) -> None:
    """Texture as fine as the photosites, which the model has blurred away."""
    found = photon_transfer_of_frames(_frames(_model(read_e=12.0), 2, seed, texture), NONE, 12, 64.0)
    assert 0.97 < found.gain_dn_e / 0.4 < 7 / 6 + 0.03
    assert 0.6 < found.read_e / 12.0 < 1.1


@pytest.mark.parametrize("pattern", [NONE, RGGB, MULTISPECTRAL], ids=["1x1", "2x2", "3x3"])
def test_deviations_cover_on_plain_scenes(pattern: np.ndarray) -> None:
    for seed in (0, 1):
        found = photon_transfer_of_frames(_frames(_model(), 2, seed, "nowhere", pattern, rough=False), pattern, 12, 64.0)
        _require_within_deviations(found, _model())
        assert 0 < found.gain_sd < 0.02 and 0 < found.read_sd < 5.0


def test_frames_that_tell_nothing_are_refused() -> None:
    flat = record(torch.full((2, 100, 120), 0.3, dtype=torch.float64), CAMERA, [0, 1], "cam").numpy()
    expected = np.full((100, 120, 1), 64 + 0.3 * 4031)
    with pytest.raises(InputError, match="no range of light"):
        photon_transfer_of_frames([(raw, expected) for raw in flat], NONE, 12, 64.0)
    with pytest.raises(InputError, match="usable values"):
        photon_transfer_of_frames([(flat[0, :10, :10], expected[:10, :10])], NONE, 12, 64.0)
    with pytest.raises(InputError, match="usable values"):
        photon_transfer_of_frames([(flat[0], np.full_like(expected, np.nan))], NONE, 12, 64.0)
    white = record(torch.full((1, 100, 120), 2.0, dtype=torch.float64), CAMERA, [0], "cam").numpy()
    with pytest.raises(InputError, match="usable values"):
        photon_transfer_of_frames([(white[0], np.full((100, 120, 1), 4095.0))], NONE, 12, 64.0)


def test_no_frames_are_refused() -> None:
    with pytest.raises(InputError, match="no frames"):
        photon_transfer_of_frames([], NONE, 12, 64.0)


def test_frames_smaller_than_a_window_are_refused() -> None:
    raw = np.full((3, 4), 100.0)
    with pytest.raises(InputError, match="usable values"):
        photon_transfer_of_frames([(raw, raw[..., None])], NONE, 12, 64.0)


def test_a_pixel_without_a_ray_costs_its_window_alone() -> None:
    frames = _frames(_model(), 2, 1, "nowhere", RGGB, rough=False)
    whole = photon_transfer_of_frames(frames, RGGB, 12, 64.0)
    for _, expected in frames:
        expected[4, 4] = np.nan
    found = photon_transfer_of_frames(frames, RGGB, 12, 64.0)
    assert found.gain_sd < 1.01 * whole.gain_sd and abs(found.gain_dn_e - whole.gain_dn_e) < 0.1 * whole.gain_sd
