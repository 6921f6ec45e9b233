"""Whites, linear maps and clusters, against closed forms and scenes whose spectra are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from painted_rooms import SENSORS, black_body, room, white
from scipy.stats import linregress

from mmsynth.prior.samples import columns_of
from mmsynth.prior.spectra import _RIDGE, Spectra, White, learn_spectra, spectral_map, white_of

KNOWN = {n: SENSORS[n] for n in ("rgb", "nir", "ms")}
COLUMNS = columns_of(KNOWN)


@pytest.fixture(scope="module")
def spectra() -> Spectra:
    return learn_spectra(KNOWN, [room(i, kelvin) for i, kelvin in enumerate((2600.0, 3000.0, 3600.0, 4800.0))])


def test_moments_are_those_of_reflected_light() -> None:
    scene = room(0, 3000.0)
    found = learn_spectra(KNOWN, [scene])
    light = np.concatenate([scene.body[n] / white(3000.0, {m: scene.exposure.gain[m] for m in KNOWN}, [n])[n] for n in KNOWN], 1)
    expected = light.T @ light / len(light)
    np.testing.assert_allclose(found.moments / found.moments[0, 0], expected / expected[0, 0], rtol=1e-9)


def test_whites_of_black_bodies_lie_near_the_line(spectra: Spectra) -> None:
    assert spectra.line[2].max() < 0.05  # of the log
    kelvin = np.array([2600.0, 3000.0, 3600.0, 4800.0])
    # Wien's law: log radiance is linear in 1 / T, so is the place on the line
    ratio = [np.log(black_body(k)[np.searchsorted([400.0], 400.0)] / black_body(k)[80]) for k in kelvin]
    assert linregress(1.0 / kelvin, ratio).rvalue ** 2 > 0.99


@pytest.mark.parametrize("kelvin", [2800.0, 3300.0, 4200.0])
def test_white_of_another_lamp_is_found_from_rgb(spectra: Spectra, kelvin: float) -> None:
    scene = room(77, kelvin)
    gains = dict(scene.exposure.gain)
    only = room(77, kelvin, names=("rgb",), gains=gains)
    stated = type(scene.exposure)(gains)
    found = white_of(spectra, COLUMNS, ["rgb"], type(only)(only.name, only.sensors, stated, only.body, only.lamp, only.images))
    true = np.log(np.concatenate([white(kelvin, gains, [n])[n] for n in KNOWN]))
    off = found.log - true
    assert np.ptp(off) < 0.06  # up to one factor
    assert not found.free.any() and found.how == "the lamps that surfaces mirror"


def test_the_level_of_what_nobody_states_is_usual_and_said_to_be_free(spectra: Spectra) -> None:
    scene = room(78, 3000.0, names=("rgb",), stated=False)
    found = white_of(spectra, COLUMNS, ["rgb"], scene)
    assert found.free[COLUMNS["nir"]].all() and found.free[COLUMNS["ms"]].all() and not found.free[COLUMNS["rgb"]].any()
    assert found.deviation[COLUMNS["nir"]].min() > 0.2  # gains of the rooms differ by a factor of e^±0.5
    assert np.isfinite(found.log).all()


def test_a_white_board_outranks_lamps(spectra: Spectra) -> None:
    scene = room(79, 3000.0, names=("rgb",))
    board = type(scene.exposure)(scene.exposure.gain, {"rgb": (0.5, 0.4, 0.1), "nir": (0.3,)})
    found = white_of(spectra, COLUMNS, ["rgb"], type(scene)(scene.name, scene.sensors, board, scene.body, scene.lamp, scene.images))
    assert found.how == "a white board"
    np.testing.assert_allclose(found.log[:4] - found.log[0], np.log([0.5, 0.4, 0.1, 0.3]) - np.log(0.5), atol=1e-12)
    assert not found.free[COLUMNS["nir"]].any() and found.deviation[COLUMNS["nir"]].max() == 0.0


def test_without_lamps_white_is_from_the_mean_colour(spectra: Spectra) -> None:
    scene = room(80, 3300.0, names=("rgb",), lamp=False, count=300)
    found = white_of(spectra, COLUMNS, ["rgb"], scene)
    true = np.log(white(3300.0, dict(scene.exposure.gain), ["rgb"])["rgb"])
    off = (found.log[COLUMNS["rgb"]] - true) - (found.log[COLUMNS["rgb"]] - true).mean()
    assert found.how == "the mean colour" and np.abs(off).max() < 0.15


def test_the_map_is_homogeneous_and_never_negative(spectra: Spectra) -> None:
    count = spectra.usual.shape[1]
    one = White(np.zeros(count), np.zeros(count), np.zeros(count, bool), "")
    mapped = spectral_map(spectra, one, np.arange(3), np.arange(3, count))
    light = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) + 0.01
    value, deviation = mapped(light)
    bright, of_bright = mapped(7.0 * light)
    torch.testing.assert_close(bright, 7.0 * value, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(of_bright, 7.0 * deviation, rtol=1e-3, atol=1e-4)
    assert (value >= 0).all() and (deviation >= 0).all()
    black, of_black = mapped(torch.zeros(2, 3))
    assert (black == 0).all() and (of_black == 0).all()


def test_without_clusters_the_map_is_least_squares(spectra: Spectra) -> None:
    count = spectra.usual.shape[1]
    empty = Spectra(spectra.moments, spectra.usual, np.zeros((0, count)), np.zeros((0, count)), np.zeros(0), 4, spectra.line, spectra.raw)
    one = White(np.zeros(count), np.zeros(count), np.zeros(count, bool), "")
    mapped = spectral_map(empty, one, np.arange(3), np.arange(3, count))
    root = np.linalg.cholesky(spectra.moments + 1e-12 * np.eye(count)).T  # rows whose second moments these are
    ridge = (_RIDGE * np.trace(spectra.moments[:3, :3]) / 3) ** 0.5 * np.eye(3)
    expected = np.linalg.lstsq(np.vstack([root[:, :3], ridge]), np.vstack([root[:, 3:], np.zeros((3, count - 3))]), rcond=None)[0]
    light = np.random.default_rng(0).uniform(0.2, 1.0, (50, 3))
    ours = mapped(torch.from_numpy(light).float())[0].numpy()
    np.testing.assert_allclose(ours, np.maximum(light @ expected, 0), rtol=1e-3, atol=1e-4)
    assert (mapped(torch.from_numpy(light).float())[1] > 0).all()
