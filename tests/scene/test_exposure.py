"""What is stated of exposures, and what cannot be."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mmsynth.errors import InputError
from mmsynth.scene.exposure import black_body, read_exposure


def test_gains_and_boards_by_any_name(tmp_path: Path) -> None:
    path = tmp_path / "exposure.json"
    path.write_text(json.dumps({"rgb": 0.006, "infrared": 2, "white": {"RGB": [0.5, 0.4, 0.2], "polarization": 0.7}}))
    found = read_exposure(path)
    assert found.gain == {"rgb": 0.006, "nir": 2.0}
    assert found.white == {"rgb": (0.5, 0.4, 0.2), "pol": (0.7,)}


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ([], "expected an object"),
        ({"rgb": 0}, "rgb: 0, expected a positive number"),
        ({"rgb": -1.0}, "positive"),
        ({"rgb": True}, "positive"),
        ({"rgb": "0.5"}, "positive"),
        ({"white": [1, 2]}, "white: expected an object"),
        ({"white": {"ms": [0.5, 0.0]}}, "white: ms: 0.0, expected a positive number"),
        ({"rgb": 10**400}, "positive"),
        ({"lamp": {"kelvin": 0}}, "lamp: kelvin: 0, expected a positive number"),
        ({"lamp": {"kelvin": 1e6}}, "lamp: kelvin: 1e[+]06, expected 500 to 50000"),
        ({"lamp": 3000}, "expected either 'kelvin', or 'nm' and 'value'"),
        ({"lamp": {"nm": [400, 500], "value": [1]}}, "lamp: .*lists of one length"),
        ({"lamp": {"nm": [400, 500], "value": [1, -1]}}, "lamp: .*greater than or equal to 0"),
    ],
)
def test_what_cannot_be_is_said(stated: Any, said: str, tmp_path: Path) -> None:
    path = tmp_path / "exposure.json"
    path.write_text(json.dumps(stated))
    with pytest.raises(InputError, match=said):
        read_exposure(path)


def test_a_lamp_by_its_temperature_or_its_spectrum(tmp_path: Path) -> None:
    path = tmp_path / "exposure.json"
    path.write_text(json.dumps({"lamp": {"nm": [400, 500, 700], "value": [0.0, 2.0, 1.0]}}))
    lamp = read_exposure(path).lamp
    assert lamp is not None and lamp.at(np.array([450.0, 600.0, 800.0])).tolist() == [1.0, 1.5, 0.0]
    path.write_text(json.dumps({"lamp": {"kelvin": 2900}}))
    lamp = read_exposure(path).lamp
    assert lamp is not None and lamp == black_body(2900.0)
    # Wien's displacement law, b = 2.898e6 nm K
    nm = np.arange(400.0, 2000.0)
    assert nm[lamp.at(nm).argmax()] == pytest.approx(2.898e6 / 2900.0, abs=5.0)
