"""Hard cases of modalities that nobody measured: what a prior cannot know it must not pretend to.

The usual way: one map from RGB to the other channels, of least squares over all scenes, without deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from painted_rooms import NM, RESPONSES, RGB, SENSORS, black_body, paints, room, white

from mmsynth.errors import InputError
from mmsynth.prior.prediction import Predicted, Seen, predict, scene_facts
from mmsynth.prior.prior import Prior, learn_prior
from mmsynth.prior.samples import SceneSamples
from mmsynth.scene.exposure import Exposure

Row = Callable[[str, str, str], None]


def _predicted(prior: Prior, scene: SceneSamples, rows: slice = slice(None)) -> dict[str, Predicted]:
    """What a prior says of a scene of which only rgb is known."""
    lamp = None if scene.lamp is None else {"rgb": scene.lamp["rgb"]}
    only = replace(scene, sensors={"rgb": RGB}, body={"rgb": scene.body["rgb"]}, lamp=lamp)
    made = predict(prior, scene_facts(prior, only, {"rgb": 0.001}), ["rgb"])
    light = torch.from_numpy(scene.body["rgb"][rows]).float()
    return made(Seen({"rgb": light}, torch.zeros(len(light), 3), None, torch.zeros(len(light), 3)))


def _usual(scenes: Sequence[SceneSamples], light: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """One matrix from the values of RGB to those of another sensor."""
    x, y = (np.concatenate([s.body[n] for s in scenes]) for n in ("rgb", name))
    return np.asarray(light @ np.linalg.lstsq(x, y, rcond=None)[0])


def _metamers() -> NDArray[np.float64]:
    """Two paints that RGB cannot tell apart, dark and bright in the near infrared."""
    base = np.full(len(NM), 0.4)
    behind = 1.0 / (1.0 + np.exp(-(NM - 760.0) / 15.0))
    return np.stack([base * (1 - behind) + 0.05 * behind, base * (1 - behind) + 0.9 * behind])


def test_metamers_are_said_to_be_unsure(row: Row) -> None:
    """Two paints of one RGB: whatever is said, one of them is wrong by half of their difference, and the deviation says so."""
    scenes = [room(i, 3000.0, reflectance=np.concatenate([_metamers(), paints(30, i)])) for i in range(4)]
    prior = learn_prior(scenes)
    scene = room(90, 3000.0, reflectance=_metamers())
    found = _predicted(prior, scene)["nir"]
    error = np.abs(found.light.numpy() - scene.body["nir"])
    usual = np.abs(_usual(scenes, scene.body["rgb"], "nir") - scene.body["nir"])
    within = float((error < 2.0 * found.deviation.numpy()).mean())
    row(
        "two paints of one RGB, 0.05 and 0.9 in near infrared",
        f"one matrix: off by {float((usual / scene.body['nir']).mean()):.0%}, and not said",
        f"within two deviations: {within:.0%}",
    )
    assert float((error / scene.body["nir"]).mean()) > 0.2  # nobody can know
    assert 0.9 < within


def test_a_spectrum_unlike_all_others_is_said_to_be_unsure(row: Row) -> None:
    """A narrow-band paint, unlike all that the prior has seen: its deviation is above that of paints of the kind it knows."""
    prior = learn_prior([room(i, 3000.0, reflectance=0.35 + 0.3 * (paints(40, i, smooth=300.0) - 0.5)) for i in range(4)])
    known = room(91, 3000.0, reflectance=0.35 + 0.3 * (paints(20, 91, smooth=300.0) - 0.5))
    odd = np.stack([0.02 + 0.9 * np.exp(-0.5 * ((NM - c) / 18.0) ** 2) for c in (455.0, 535.0, 612.0)])
    strange = replace(room(91, 3000.0, reflectance=odd), lamp=known.lamp, exposure=known.exposure)
    relative = lambda scene: float((_predicted(prior, scene)["nir"].deviation.numpy() / scene.body["rgb"].mean(1, keepdims=True)).mean())
    row(
        "a paint of narrow bands, unlike all of the prior",
        "one matrix: as sure as ever",
        f"deviation {relative(strange) / relative(known):.1f} times that of known paints",
    )
    assert relative(strange) > 1.3 * relative(known)


def test_another_lamp(row: Row) -> None:
    """Rooms under lamps of 2700 to 5000 K, a new one under 3300 K: whites of black bodies lie on a line, one matrix mixes lamps."""
    scenes = [room(i, kelvin, gains={n: 0.05 for n in SENSORS}, count=200) for i, kelvin in enumerate((2700.0, 2900.0, 4200.0, 5000.0))]
    prior = learn_prior(scenes)
    scene = room(92, 3300.0, gains={n: 0.05 for n in SENSORS}, count=200)
    rms = lambda values: float(((values - scene.body["ms"]) ** 2).mean() ** 0.5 / scene.body["ms"].mean())
    ours, usual = rms(_predicted(prior, scene)["ms"].light.numpy()), rms(_usual(scenes, scene.body["rgb"], "ms"))
    row("rooms of 2700 to 5000 K, a new one of 3300 K", f"one matrix: off by {usual:.1%}", f"off by {ours:.1%}")
    assert ours < 0.95 * usual


def test_clipped_and_dark_pixels_stay_numbers(row: Row) -> None:
    """Black, and brighter than full scale: chromaticities divide by the light."""
    prior = learn_prior([room(i, 3000.0) for i in range(3)])
    scene = room(93, 3000.0)
    scene.body["rgb"][:3] = [[0.0, 0.0, 0.0], [50.0, 50.0, 50.0], [1e-12, 0.0, 0.0]]
    found = _predicted(prior, scene, slice(0, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        usual = scene.body["rgb"][:3] / scene.body["rgb"][:3].mean(1, keepdims=True)
    row("a black pixel", f"chromaticity: {int(np.isnan(usual).sum())} NaN", "black, with a deviation of 0")
    assert np.isnan(usual).any()
    for name in ("nir", "ms"):
        assert torch.isfinite(found[name].light).all() and torch.isfinite(found[name].deviation).all()
        assert (found[name].light[0] == 0).all() and (found[name].light[1] > found[name].light[2]).all()


def test_a_grey_world_teaches_no_colours(row: Row) -> None:
    """All paints of all scenes are grey: colours were never seen, and the map must not be singular."""
    grey = np.linspace(0.05, 0.9, 12)[:, None] * np.ones(len(NM))
    prior = learn_prior([room(i, 3000.0, reflectance=grey) for i in range(3)])
    scene = room(94, 3000.0, reflectance=grey)
    ours = _predicted(prior, scene)
    gram = np.concatenate([s.body["rgb"] / white(3000.0, {"rgb": 1.0}, ["rgb"])["rgb"] for s in (scene,)])
    condition = float(np.linalg.cond(gram.T @ gram))
    error = float(np.abs(ours["ms"].light.numpy() / scene.body["ms"] - 1.0).max())
    row("a grey world", f"normal equations of condition {condition:.0e}", f"off by {error:.1%}")
    assert condition > 1e12 and error < 0.02


def test_other_wavelengths_are_not_taken_for_the_same(row: Row) -> None:
    """The scene has a modality of the prior's name in other wavelengths: it is neither believed nor overwritten."""
    prior = learn_prior([room(i, 3000.0) for i in range(3)])
    scene = room(95, 3000.0)
    other = replace(SENSORS["ms"], wavelengths_nm=(470.0, 570.0, 670.0, 720.0))
    mixed = replace(scene, sensors={"rgb": RGB, "ms": other}, body={n: scene.body[n] for n in ("rgb", "ms")})
    facts = scene_facts(prior, mixed, {"rgb": 0.001, "ms": 0.001})
    assert facts.known == ("rgb",)
    row("a sensor of the prior's name in other wavelengths", "taken for the same by its name", "neither believed nor overwritten")
    assert list(predict(prior, facts, ["rgb", "ms"]).sensors) == ["nir"]
    alone = replace(mixed, sensors={"ms": other}, body={"ms": scene.body["ms"]})
    with pytest.raises(InputError, match="470 nm"):
        scene_facts(prior, alone, {"ms": 0.001})


def test_an_empty_prior_knows_what_is_linear(row: Row) -> None:
    """Scenes so dark that no pixel has a colour: no cluster, no deviation from clusters; what is left is the linear map and its error."""
    dark = np.full((1, len(NM)), 1e-3)
    dim = room(0, 3000.0, reflectance=dark, rays=3)  # fewer pixels than a cluster has
    prior = learn_prior([dim])
    assert len(prior.spectra.share) == 0
    row("a prior of scenes without a lit pixel", "mean of no clusters: NaN", "the linear map and its error")
    found = _predicted(prior, room(96, 3000.0))
    assert all(torch.isfinite(found[n].light).all() and torch.isfinite(found[n].deviation).all() for n in ("nir", "ms"))


def test_a_scene_without_stated_exposure_has_a_free_level(row: Row) -> None:
    """Gains that nobody states: the level is what is usual, and its deviation is that of the prior's scenes."""
    prior = learn_prior([room(i, 3000.0) for i in range(6)])
    scene = replace(room(97, 3000.0), exposure=Exposure())
    found = _predicted(prior, scene)["nir"]
    error = np.abs(found.light.numpy() - scene.body["nir"])
    assert 0.85 < (error < 2.0 * found.deviation.numpy()).mean()  # made-up paints have longer tails than a normal distribution
    gain = float((found.light.numpy() * scene.body["nir"]).sum() / (found.light.numpy() ** 2).sum())
    free = np.abs(gain * found.light.numpy() - scene.body["nir"])
    told = float((error < 2.0 * found.deviation.numpy()).mean())
    row("gains that nobody states", "a level as if it were known", f"what is usual, said to be free: within two deviations {told:.0%}")
    assert free.mean() < error.mean()


def test_responses_of_the_rooms_are_what_they_say() -> None:
    """The peak of each made-up sensor, and of a black body (Wien's displacement)."""
    assert [float(NM[r.argmax()]) for r in RESPONSES["ms"]] == [450.0, 550.0, 650.0, 700.0]
    assert abs(NM[black_body(4000.0).argmax()] - 2.897772e6 / 4000.0) < 6.0
