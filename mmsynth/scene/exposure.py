"""What is known of exposures and of the lamps' colour: ``exposure.json`` beside a scene, or a file of the user's own.

``{"rgb": 0.0061, "ms": 0.0168}`` states the gain of each modality: value = gain x radiance within the response, in any unit that is the
same for all of them (exposure time x aperture x gain of the amplifier, say). ``{"white": {"rgb": [0.61, 0.44, 0.22], "ms": [...]}}`` states
what a white (or grey) board under the scene's light shows in each channel of a modality: gain and lamp at once. ``{"lamp": {"kelvin":
2900}}``, or ``{"lamp": {"nm": [400, ...], "value": [0.2, ...]}}``, states the spectrum of the scene's lamps in any unit, that of a black
body or measured; a prior uses it for channels whose responses it knows. All may be there; names may be aliases. What is not stated is free:
a prior then takes what is usual, and says so.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.scene import Scene, canonical_modality
from mmsynth.sensors.sensor_file import Response

FILE_NAME = "exposure.json"
_MOST = 1e30
_KELVIN = (500.0, 50_000.0)
_BLACK_BODY_NM = np.arange(300.0, 2501.0, 5.0)


@dataclass(frozen=True)
class Exposure:
    """What is stated, by canonical modality name.

    Attributes:
        gain: > 0. white: per channel > 0, what a white board shows, 1.0 = full scale; of a polarization modality one number, S0.
        lamp: power of the scene's lamps over wavelength, in any unit.
    """

    gain: dict[str, float] = field(default_factory=dict)
    white: dict[str, tuple[float, ...]] = field(default_factory=dict)
    lamp: Response | None = None


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
    gains = {name: value for name, value in stated.items() if name not in ("white", "lamp")}
    gain = {canonical_modality(name): _positive(value, f"{path}: {name}") for name, value in gains.items()}
    white = {
        canonical_modality(name): tuple(_positive(v, f"{path}: white: {name}") for v in (values if isinstance(values, list) else [values]))
        for name, values in boards.items()
    }
    return Exposure(gain, white, _lamp(stated["lamp"], f"{path}: lamp") if "lamp" in stated else None)


def black_body(kelvin: float) -> Response:
    """Radiance of a black body at 300 to 2500 nm (Planck's law), 1 where it is most."""
    nm = _BLACK_BODY_NM
    power = nm**-5.0 / np.expm1(1.438776877e7 / (nm * kelvin))  # hc/k in nm K
    return Response.model_validate({"nm": nm.tolist(), "value": (power / power.max()).tolist()})


def _lamp(stated: Any, where: str) -> Response:
    if isinstance(stated, dict) and set(stated) == {"kelvin"}:
        kelvin = _positive(stated["kelvin"], f"{where}: kelvin")
        if not _KELVIN[0] <= kelvin <= _KELVIN[1]:
            raise InputError(f"{where}: kelvin: {kelvin:g}, expected {_KELVIN[0]:g} to {_KELVIN[1]:g}.")
        return black_body(kelvin)
    if not isinstance(stated, dict) or set(stated) != {"nm", "value"}:
        raise InputError(f"{where}: expected either 'kelvin', or 'nm' and 'value'.")
    try:
        return Response.model_validate(stated)
    except ValidationError as error:
        raise InputError(f"{where}: {error.errors()[0]['msg'].removeprefix('Value error, ')}.") from error


def _positive(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < _MOST:
        shown = value if len(repr(value)) < 40 else "a number of many digits"
        raise InputError(f"{where}: {shown!r}, expected a positive number.")
    return float(value)
