"""What is stated of exposures, and what cannot be."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from mmsynth.errors import InputError
from mmsynth.scene.exposure import read_exposure


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
    ],
)
def test_what_cannot_be_is_said(stated: Any, said: str, tmp_path: Path) -> None:
    path = tmp_path / "exposure.json"
    path.write_text(json.dumps(stated))
    with pytest.raises(InputError, match=said):
        read_exposure(path)
