"""What is known of exposures and of the lamps' colour: ``exposure.json`` beside a scene, or a file of the user's own.

``{"rgb": 0.0061, "ms": 0.0168}`` states the gain of each modality: value = gain x radiance within the response, in any unit that is the
same for all of them (exposure time x aperture x gain of the amplifier, say). ``{"white": {"rgb": [0.61, 0.44, 0.22], "ms": [...]}}`` states
what a white (or grey) board under the scene's light shows in each channel of a modality: gain and lamp at once. Both may be there; names
may be aliases. What is not stated is free: a prior then takes what is usual, and says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.scene import Scene, canonical_modality

FILE_NAME = "exposure.json"
_MOST = 1e30


@dataclass(frozen=True)
class Exposure:
    """What is stated, by canonical modality name.

    Attributes:
        gain: > 0. white: per channel > 0, what a white board shows, 1.0 = full scale; of a polarization modality one number, S0.
    """

    gain: dict[str, float] = field(default_factory=dict)
    white: dict[str, tuple[float, ...]] = field(default_factory=dict)


def stated_exposure(scene: Scene, path: Path | None = None) -> Exposure:
    """Of ``path``, else of ``exposure.json`` in the scene's folder, else nothing.

    Raises:
        InputError: the file is missing or broken, or states what cannot be.
    """
    found = path or scene.root / FILE_NAME
    if path is None and not found.is_file():
        return Exposure()
    return read_exposure(found)


def read_exposure(path: Path) -> Exposure:
    """Read a file (form: module docstring). Raises InputError: not readable, or a gain or white that is no positive number."""
    stated = read_json(path)
    if not isinstance(stated, dict):
        raise InputError(f"{path}: expected an object of modalities and their gains.")
    boards = stated.get("white", {})
    if not isinstance(boards, dict):
        raise InputError(f"{path}: white: expected an object of modalities and what a white board shows in each of their channels.")
    gain = {canonical_modality(name): _positive(value, f"{path}: {name}") for name, value in stated.items() if name != "white"}
    white = {
        canonical_modality(name): tuple(_positive(v, f"{path}: white: {name}") for v in (values if isinstance(values, list) else [values]))
        for name, values in boards.items()
    }
    return Exposure(gain, white)


def _positive(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < _MOST:
        shown = value if len(repr(value)) < 40 else "a number of many digits"
        raise InputError(f"{where}: {shown!r}, expected a positive number.")
    return float(value)
