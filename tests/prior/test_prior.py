"""A prior as a whole: learned, written, read, made ready for a scene, asked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from painted_rooms import POL, RGB, SENSORS, light_of, paints, room

from mmsynth.errors import InputError
from mmsynth.prior.polarization import INPUTS, inputs_of, learn_polarization
from mmsynth.prior.prediction import Prediction, SceneFacts, Seen, predict, scene_facts
from mmsynth.prior.prior import Prior, learn_prior, load_prior, save_prior
from mmsynth.prior.samples import Shapes, column_count, columns_of
from mmsynth.scene.exposure import Exposure
from mmsynth.sensors.polarization import stokes_to_intensities

ALL = ("rgb", "nir", "ms", "pol")


@pytest.fixture(scope="module")
def prior() -> Prior:
    return learn_prior([room(i, kelvin, names=ALL) for i, kelvin in enumerate((2700.0, 3000.0, 4000.0, 5000.0))])


def made_ready(prior: Prior, seed: int = 50, kelvin: float = 3300.0, **facts: object) -> tuple[Prediction, Seen, dict[str, np.ndarray]]:
    """A new room of which only rgb is known, what it looks like, and the truth."""
    whole = room(seed, kelvin, names=ALL)
    exposure = Exposure(dict(whole.exposure.gain))
    only = replace(whole, sensors={"rgb": RGB}, body={"rgb": whole.body["rgb"]}, lamp={"rgb": whole.lamp["rgb"]}, exposure=exposure)  # type: ignore[index]
    prediction = predict(prior, scene_facts(prior, only, {"rgb": 0.001}), ["rgb"])
    rays = len(whole.images)
    body = {"rgb": torch.from_numpy(whole.body["rgb"]).float()}
    return (
        prediction,
        Seen(body, torch.zeros(rays, 3), whole.shapes, torch.zeros(rays, 3)),
        dict(whole.body) | {"polarized": whole.polarized},
    )  # type: ignore[dict-item]


def test_a_new_room_is_predicted_and_deviations_hold(prior: Prior) -> None:
    prediction, seen, truth = made_ready(prior)
    found = prediction(seen)
    assert list(found) == ["nir", "ms", "pol"]
    for name in ("nir", "ms"):
        light, deviation = found[name].light.numpy(), found[name].deviation.numpy()
        error = light - truth[name]
        # better than saying that all surfaces are alike, and as sure as it may be
        assert (error**2).mean() < 0.5 * truth[name].var()
        assert 0.80 < (np.abs(error) < 2.0 * deviation).mean() <= 1.0
    # ms lies between the peaks of rgb, near infrared behind them
    relative = {n: float(((found[n].light.numpy() - truth[n]) ** 2).mean() ** 0.5 / truth[n].mean()) for n in ("nir", "ms")}
    unsure = {n: float((found[n].deviation / found[n].light.clamp(min=1e-9)).median()) for n in ("nir", "ms")}
    assert relative["ms"] < relative["nir"] and unsure["ms"] < unsure["nir"]


def test_polarization_follows_the_angle(prior: Prior) -> None:
    prediction, seen, truth = made_ready(prior)
    found = prediction(seen)["pol"]
    assert found.stokes is not None
    true = np.concatenate([truth["pol"], truth["polarized"]], 1)
    error = ((found.stokes.numpy() - true)[:, 1:] ** 2).mean()
    assert error < 0.15 * (true[:, 1:] ** 2).mean()  # of saying "unpolarized"
    assert (torch.linalg.vector_norm(found.stokes[:, 1:], dim=1) <= found.stokes[:, 0] * (1 + 1e-5)).all()
    torch.testing.assert_close(found.light, stokes_to_intensities(found.stokes, POL.polarizer_angles_deg or ()))


def test_predictions_scale_with_exposure(prior: Prior) -> None:
    prediction, seen, _ = made_ready(prior)
    facts = prediction.facts
    twice = replace(facts, white=tuple(w + np.log(2.0) for w in facts.white), error=tuple(2 * e for e in facts.error))
    brighter = predict(prior, twice, ["rgb"])(replace(seen, body={"rgb": 2.0 * seen.body["rgb"]}))
    for name, found in prediction(seen).items():
        torch.testing.assert_close(brighter[name].light, 2.0 * found.light, rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(brighter[name].deviation, 2.0 * found.deviation, rtol=1e-3, atol=1e-5)


def test_images_of_lamps_have_the_lamps_colour(prior: Prior) -> None:
    prediction, seen, _ = made_ready(prior)
    images = torch.zeros(len(seen.images), 3)
    images[:, 0], images[:, 1] = 0.5, 0.2
    with_lamps, without = prediction(replace(seen, images=images)), prediction(seen)
    white = torch.exp(torch.tensor(prediction.facts.white))
    columns = columns_of(prior.sensors)
    for name in ("nir", "ms"):
        more = with_lamps[name].light - without[name].light
        torch.testing.assert_close(more, (0.5 * prediction.facts.lamp * white[columns[name]]).expand_as(more), rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(more, with_lamps[name].images, rtol=1e-3, atol=1e-5)


def test_a_frame_tells_what_a_paint_is_behind_the_visible(prior: Prior) -> None:
    prediction, seen, truth = made_ready(prior)
    rays = torch.arange(0, len(seen.images), 2)
    half = Seen({"rgb": seen.body["rgb"][rays]}, seen.images[rays], None, seen.position[rays])
    measured = torch.from_numpy(truth["nir"]).float()[rays, 0]
    learned = prediction.corrected("nir", half, torch.zeros(len(rays), dtype=torch.int64), measured, 1)
    others = torch.arange(1, len(seen.images), 2)
    rest = Seen({"rgb": seen.body["rgb"][others]}, seen.images[others], None, seen.position[others])
    before, after = (p(rest)["nir"] for p in (prediction, learned))
    true = torch.from_numpy(truth["nir"]).float()[others]
    assert (after.light - true).square().mean() < 0.7 * (before.light - true).square().mean()
    assert after.deviation.mean() < before.deviation.mean()
    assert learned.corrections["nir"].after < learned.corrections["nir"].before
    # what it was not told of is as it was
    torch.testing.assert_close(learned(rest)["ms"].light, prediction(rest)["ms"].light)


def test_written_and_read_it_says_the_same(prior: Prior, tmp_path: Path) -> None:
    prediction, seen, _ = made_ready(prior)
    save_prior(prior, tmp_path / "p.safetensors")
    assert (tmp_path / "p.safetensors").stat().st_size < 1_000_000
    again = predict(load_prior(tmp_path / "p.safetensors"), prediction.facts, ["rgb"])(seen)
    for name, found in prediction(seen).items():
        torch.testing.assert_close(again[name].light, found.light, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(again[name].deviation, found.deviation, rtol=1e-3, atol=1e-6)
    assert [column_count(s) for s in load_prior(tmp_path / "p.safetensors").sensors.values()] == [3, 1, 4, 1]


@pytest.mark.parametrize("content", [b"", b"not a tensor", b"\x08\0\0\0\0\0\0\0{}      "])
def test_what_is_no_prior_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "p.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError, match="prior"):
        load_prior(path)
    with pytest.raises(InputError, match="no such file"):
        load_prior(tmp_path / "none.safetensors")


def test_scenes_that_teach_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="one modality"):
        learn_prior([room(0, 3000.0, names=("rgb",))])
    with pytest.raises(InputError, match="no scenes"):
        learn_prior([])
    other = room(1, 3000.0)
    renamed = replace(other, sensors=dict(other.sensors) | {"ms": replace(SENSORS["ms"], wavelengths_nm=(460.0, 560.0, 660.0, 710.0))})
    with pytest.raises(InputError, match="450nm"):
        learn_prior([room(0, 3000.0), renamed])


def test_the_same_samples_give_the_same_prior(prior: Prior) -> None:
    again = learn_prior([room(i, kelvin, names=ALL) for i, kelvin in enumerate((2700.0, 3000.0, 4000.0, 5000.0))])
    np.testing.assert_array_equal(again.spectra.mean, prior.spectra.mean)
    assert again.polarization is not None and prior.polarization is not None
    assert all(torch.equal(a, b) for a, b in zip(again.polarization.weights, prior.polarization.weights, strict=True))


def test_facts_survive_json(prior: Prior) -> None:
    import json
    from dataclasses import asdict

    facts = made_ready(prior)[0].facts
    assert SceneFacts.from_json(json.loads(json.dumps(asdict(facts)))) == facts


def test_the_network_learns_a_formula_and_how_far_it_is_off() -> None:
    random = torch.Generator().manual_seed(3)
    n = 20_000
    cosine = torch.rand(n, generator=random) * 0.9 + 0.1
    colour, zero = torch.rand(n, 3, generator=random) + 0.2, torch.zeros(n)
    shapes = Shapes(cosine, torch.zeros(n, 2), zero, zero)
    inputs = inputs_of(colour, zero, shapes)
    assert inputs.shape == (n, INPUTS)
    noise = 0.02 + 0.1 * (cosine < 0.5)
    q = 0.5 * (1 - cosine) ** 2 - 0.2 + noise * torch.randn(n, generator=random)
    net = learn_polarization(inputs, q, torch.ones(n))
    said, deviation = net(inputs)
    assert (said - (0.5 * (1 - cosine) ** 2 - 0.2)).abs().mean() < 0.015
    assert deviation[cosine < 0.5].median() > 2.0 * deviation[cosine > 0.5].median()


def test_paints_of_the_tests_are_light(prior: Prior) -> None:
    reflectance = paints(10, 0)
    assert 0.0 < reflectance.min() and reflectance.max() < 1.0
    light = light_of(reflectance, np.ones(10), 3000.0, {"rgb": 1.0}, ["rgb"])["rgb"]
    assert light.shape == (10, 3) and (light > 0).all()
