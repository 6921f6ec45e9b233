"""A prior of one rig for another: combinations of channels against light of the other rig's own responses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from painted_rooms import NM, RESPONSES, RGB, SENSORS, black_body, light_of, paints, room

from mmsynth.errors import InputError
from mmsynth.prior.prediction import Seen, predict, scene_facts
from mmsynth.prior.prior import Prior, learn_prior
from mmsynth.prior.responses import for_sensors, with_responses
from mmsynth.scene.exposure import Exposure
from mmsynth.scene.scene import Sensor
from mmsynth.sensors.noise import NoiseModel
from mmsynth.sensors.sensor_file import Channel, Response, SensorFile

_NOISE = NoiseModel(bits=12, gain_dn_e=0.5, full_well_e=8000.0, read_e=3.0)
_SD_TO_FWHM = 2.0 * (2.0 * np.log(2.0)) ** 0.5


def sensor_file(sensor: Sensor, peaks: tuple[float, ...], sd: float) -> SensorFile:
    channels = tuple(
        Channel(label=label, response=Response(centre_nm=p, fwhm_nm=sd * _SD_TO_FWHM))
        for label, p in zip(sensor.channels, peaks, strict=True)
    )
    return SensorFile(name=f"test_{sensor.name}", instance_of=sensor.name, channels=channels, noise=_NOISE)


RGB_FILE = sensor_file(RGB, (610.0, 540.0, 460.0), 35.0)
MS_FILE = sensor_file(SENSORS["ms"], (450.0, 550.0, 650.0, 700.0), 15.0)
NIR_FILE = sensor_file(SENSORS["nir"], (860.0,), 50.0)
OTHER = Sensor("rgb", ("r", "g", "b"), (None, None, None))
OTHER_FILE = sensor_file(OTHER, (620.0, 530.0, 455.0), 30.0)


@pytest.fixture(scope="module")
def prior() -> Prior:
    made = learn_prior([room(i, kelvin) for i, kelvin in enumerate((2700.0, 3100.0, 4000.0, 5000.0))])
    return with_responses(made, [RGB_FILE, MS_FILE, NIR_FILE])


def test_another_camera_is_expressed_by_the_priors_channels(prior: Prior) -> None:
    adapted = for_sensors(prior, {"rgb": OTHER}, [OTHER_FILE])
    assert adapted.sensors["rgb"] == OTHER and list(adapted.sensors) == list(prior.sensors)
    # a new room, seen by the other camera
    pigments, random = paints(40, 70), np.random.default_rng(70)
    which, shade, kelvin, gain = random.integers(0, 40, 2000), random.uniform(0.2, 1.0, 2000), 3300.0, 0.03
    responses = np.stack([np.exp(-0.5 * ((NM - p) / 30.0) ** 2) for p in (620.0, 530.0, 455.0)])
    body = gain * shade[:, None] * (pigments[which] * black_body(kelvin) @ responses.T)
    truth = light_of(pigments[which], shade, kelvin, {"ms": 0.05}, ["ms"])["ms"]
    lamp = {"rgb": gain * (responses @ black_body(kelvin))}
    scene = replace(
        room(70, kelvin, rays=2000), sensors={"rgb": OTHER}, body={"rgb": body}, lamp=lamp, exposure=Exposure({"rgb": gain, "ms": 0.05})
    )
    seen = Seen({"rgb": torch.from_numpy(body).float()}, torch.zeros(2000, 3), None, torch.zeros(2000, 3))
    rms = lambda p: float(((p - truth) ** 2).mean() ** 0.5 / (truth**2).mean() ** 0.5)
    ours = rms(predict(adapted, scene_facts(adapted, scene, {"rgb": 0.001}), ["rgb"])(seen)["ms"].light.numpy())
    # as if it were the prior's own camera
    mistaken = replace(scene, sensors={"rgb": RGB})
    usual = rms(predict(prior, scene_facts(prior, mistaken, {"rgb": 0.001}), ["rgb"])(seen)["ms"].light.numpy())
    assert ours < 0.2 and ours < usual


def test_wavelengths_that_the_prior_never_saw_are_named(prior: Prior) -> None:
    swir = Sensor("swir", ("swir",), (1300.0,))
    with pytest.raises(InputError, match=r"swir.*1[12]\d\d-1[345]\d\d nm"):
        for_sensors(prior, {"rgb": RGB, "swir": swir}, [sensor_file(swir, (1300.0,), 40.0)])


def test_the_same_camera_changes_nothing(prior: Prior) -> None:
    assert for_sensors(prior, {"rgb": RGB}, [RGB_FILE]) is prior


def test_files_that_do_not_fit_are_refused(prior: Prior) -> None:
    with pytest.raises(InputError, match="not in the scene"):
        for_sensors(prior, {"rgb": RGB}, [MS_FILE])
    with pytest.raises(InputError, match="channels are r, g, b, expected those of rgb: R, G, B"):
        with_responses(prior, [OTHER_FILE])
    with pytest.raises(InputError, match="made without sensor files"):
        for_sensors(replace(prior, responses={}), {"rgb": OTHER}, [OTHER_FILE])


def stated_lamp(kelvin: float) -> Response:
    """The rooms have no light beyond NM."""
    return Response.model_validate({"nm": NM.tolist(), "value": black_body(kelvin).tolist()})


def test_a_stated_lamp_is_the_white_of_channels_with_responses(prior: Prior) -> None:
    # a lamp far off those of the prior's scenes, in a room where nothing mirrors it and all things are of one colour
    kelvin, gains = 9000.0, {"rgb": 0.03, "nir": 0.02, "ms": 0.05, "pol": 0.01}
    scene = room(5, kelvin, names=("rgb",), gains=gains, lamp=False, reflectance=paints(1, 3))
    expected = np.log(np.concatenate([gains[n] * (RESPONSES[n] @ black_body(kelvin)) for n in ("rgb", "nir", "ms")]))
    lit = replace(scene, exposure=Exposure({n: gains[n] for n in ("rgb", "nir", "ms")}, lamp=stated_lamp(kelvin)))
    facts = scene_facts(prior, lit, {"rgb": 0.001})
    assert facts.how == "the stated lamp" and not facts.free
    found = np.array(facts.white)
    np.testing.assert_allclose(found - found.mean(), expected - expected.mean(), atol=0.01)
    without = np.array(scene_facts(prior, replace(lit, exposure=replace(lit.exposure, lamp=None)), {"rgb": 0.001}).white)
    assert np.abs(without - without.mean() - expected + expected.mean()).max() > 0.1


def test_without_gains_a_lamp_says_colours_and_no_levels(prior: Prior) -> None:
    scene = replace(room(5, 3000.0, names=("rgb",), lamp=False), exposure=Exposure(lamp=stated_lamp(3000.0)))
    facts = scene_facts(prior, scene, {"rgb": 0.001})
    expected = np.log(RESPONSES["rgb"] @ black_body(3000.0))
    np.testing.assert_allclose(np.diff(facts.white[:3]), np.diff(expected), atol=0.01)
    assert set(facts.free) == {"nir", "ms"} and min(facts.white_deviation[3:]) > 0.05
