"""calibration.json: what is written is read back, what is wrong gets a sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mmsynth.errors import InputError
from mmsynth.scene.layouts.calibration import RigSensor, read_calibration, write_calibration
from mmsynth.sensors.camera import Camera, Lens

REFERENCE = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 31.5, "cy": 23.5, "camera2reference": np.eye(4).tolist()}


def _write(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.sampled_from((0, 4, 5, 6, 8)), fisheye=st.booleans())
def test_written_rigs_are_read_back(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int, fisheye: bool) -> None:
    random = np.random.default_rng(seed)
    lens: Lens = "kannala_brandt" if fisheye else "brown_conrady"
    distortion = tuple(random.normal(scale=0.01, size=4 if fisheye else count))
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = Rotation.random(random_state=seed).as_matrix(), random.normal(size=3)
    rig = {
        "rgb": RigSensor(Camera(640, 480, 600.25, 601.5, 319.5, 240.125), np.eye(4), {"mosaick_pattern": [[1, 2], [0, 1]]}, "rgb"),
        "nir": RigSensor(Camera(320, 240, *random.uniform(100, 300, 4), distortion, lens), place, {}, "infrared"),
    }
    path = tmp_path_factory.mktemp("rig") / "calibration.json"
    write_calibration(path, rig)
    assert list(json.loads(path.read_text())) == ["rgb", "infrared"]
    back = read_calibration(path)
    assert list(back) == ["rgb", "nir"]
    for name, sensor in rig.items():
        assert (back[name].described, back[name].source_name) == (sensor.described, sensor.source_name)
        assert np.array_equal(back[name].camera.intrinsics, sensor.camera.intrinsics)
        assert np.array_equal(back[name].camera.coefficients, sensor.camera.coefficients)
        assert back[name].camera.lens == sensor.camera.lens or not any(sensor.camera.distortion)
        assert np.abs(back[name].camera_to_reference - sensor.camera_to_reference).max() < 1e-14


def test_the_example_of_the_format_is_read(tmp_path: Path) -> None:
    """Six coefficients in OpenCV's order, as MMS-DATA's source scenes have them; the reference is the first key."""
    lens = [-0.1, 0.08, 3e-4, -2e-4, 0.01, 0.002]
    entry = {
        **REFERENCE,
        "sensor": "Basler",
        "distortion_params": lens,
        "mosaick_pattern": [[1, 2], [0, 1]],
    }
    sensor = read_calibration(_write(tmp_path / "calibration.json", {"rgb": entry}))["rgb"]
    assert sensor.camera.coefficients.tolist() == [*lens, 0.0, 0.0]
    assert sensor.described == {"mosaick_pattern": [[1, 2], [0, 1]]}


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ([], "expected an object with one entry"),
        ({}, "expected an object with one entry"),
        ({"rgb": 3}, "sensor 'rgb' is not an object"),
        ({"nir": REFERENCE, "infrared": REFERENCE}, "two sensors are called 'nir'"),
        ({"rgb": {**REFERENCE, "fx": None}}, "key 'fx' is None"),
        ({"rgb": {**REFERENCE, "distortion_params": [0.1, 0.2, 0.3]}}, "3 coefficients"),
        ({"rgb": {**REFERENCE, "distortion_params": ["a"]}}, "expected a list of numbers"),
        ({"rgb": {**REFERENCE, "camera2reference": None}}, "camera2reference"),
        ({"rgb": {**REFERENCE, "camera2reference": np.diag([1.0, -1.0, -1.0, 1.0]).tolist()}}, "to be the identity"),
    ],
)
def test_bad_calibrations_get_a_sentence(tmp_path: Path, content: object, sentence: str) -> None:
    with pytest.raises(InputError) as raised:
        read_calibration(_write(tmp_path / "calibration.json", content))
    assert sentence in str(raised.value) and "calibration.json" in str(raised.value)
