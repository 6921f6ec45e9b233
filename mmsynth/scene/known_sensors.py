"""Sensors as a file describes them: by its own keys, else by what is known about the name of a modality."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.images import is_grey, saturation_level
from mmsynth.scene.scene import Sensor, canonical_modality
from mmsynth.sensors.mosaic import pattern_of

DESCRIBED_BY = ("mosaick_pattern", "channels", "wavelengths_nm", "polarizer_angles_deg")
"""Keys of a file by which ``make_sensor`` knows a sensor."""

_MS_NM = (692.0, 653.0, 611.0, 572.0, 541.0, 503.0, 464.0, 431.0, None)

# labels, wavelengths (None: broad), polarizer angles and raw pattern of the modalities of MMS-DATA
KNOWN: dict[str, dict[str, Any]] = {
    "rgb": {"channels": ("R", "G", "B"), "pattern": [[1, 2], [0, 1]]},
    "mono": {"channels": ("mono",), "pattern": [[0]]},
    "nir": {"channels": ("nir",), "pattern": [[0]]},
    "pol": {"channels": ("I0", "I45", "I90", "I135"), "angles": (0.0, 45.0, 90.0, 135.0), "pattern": [[2, 1], [3, 0]]},
    "ms": {
        "channels": tuple("pan" if nm is None else f"{nm:.0f}nm" for nm in _MS_NM),
        "wavelengths": _MS_NM,
        "pattern": [[4, 5, 6], [2, 1, 0], [3, 8, 7]],
    },
}


def wanted_modalities(known: Iterable[str], asked: Sequence[str] | None, path: Path) -> set[str]:
    """Canonical names to read; an InputError lists the known ones if one asked for is not among them."""
    names = list(known)
    if asked is None:
        return set(names)
    for name in asked:
        if canonical_modality(name) not in names:
            raise InputError(f"{path}: no modality '{name}' in this scene, expected one of {', '.join(names)}.")
    if not asked:
        raise InputError(f"{path}: no modality asked for, expected at least one of {', '.join(names)}.")
    return {canonical_modality(name) for name in asked}


def make_sensor(name: str, entry: Mapping[str, Any], where: str, image: np.ndarray, raw: bool) -> Sensor:
    """Describe a sensor by its entry in the file, what is known about its name, and its first image.

    Args:
        name: canonical modality name; an unknown one is a plain radiance modality.
        entry: may hold ``mosaick_pattern``, ``channels``, ``wavelengths_nm``, ``polarizer_angles_deg``.
        image: the first frame as stored, for the channel count of full-channel frames and the saturation level.
        raw: frames are mosaicked. A pattern of one channel counts as no mosaic.
    Raises:
        InputError: pattern with holes or not a matrix, or lists whose length is not the channel count.
    """
    known = KNOWN.get(name, {})
    for key, types in (("channels", (str,)), ("wavelengths_nm", (int, float, type(None))), ("polarizer_angles_deg", (int, float))):
        values = entry.get(key, [])
        if not isinstance(values, list) or not all(isinstance(value, types) for value in values):
            raise InputError(f"{where}: key '{key}' is {values!r}, expected a list with one entry per channel.")
    given = entry.get("mosaick_pattern", known.get("pattern")) if raw else None
    mosaic = None if given is None else _pattern(given, where)
    if mosaic is not None:
        count = int(mosaic.max()) + 1
    else:
        count = 1 if image.ndim == 2 else image.shape[2]
        # grey + alpha and RGB + alpha: load_frame takes the alpha off
        expected = len(entry.get("channels", known.get("channels", ())))
        if (count == 2 and expected in (0, 1)) or (count == 4 and expected in (0, 1, 3)):
            count = expected or count - 1
        elif count == 3 and expected == 1 and is_grey(image):
            count = 1
    labels = entry.get("channels")
    if labels is None:
        plain = {1: (name,), 3: ("R", "G", "B")}.get(count, tuple(map(str, range(count))))
        labels = known["channels"] if len(known.get("channels", ())) == count else plain
    same = tuple(labels) == known.get("channels")
    wavelengths = entry.get("wavelengths_nm") or (known.get("wavelengths") if same else None) or (None,) * count
    angles = entry.get("polarizer_angles_deg") or (known.get("angles") if same else None)
    if name == "pol" and angles is None:
        raise InputError(f"{where}: {count} polarization channels, expected 4 or the key 'polarizer_angles_deg' with an angle for each.")
    for key, values in (("channels", labels), ("wavelengths_nm", wavelengths), ("polarizer_angles_deg", angles)):
        if values is not None and len(values) != count:
            raise InputError(f"{where}: key '{key}' has {len(values)} entries, expected {count}, one per channel.")
    return Sensor(
        name=name,
        channels=tuple(str(label) for label in labels),
        wavelengths_nm=tuple(None if nm is None else float(nm) for nm in wavelengths),
        mosaic=mosaic if count > 1 else None,
        polarizer_angles_deg=None if angles is None else tuple(float(angle) for angle in angles),
        saturation=saturation_level(image),
    )


def _pattern(given: Any, where: str) -> np.ndarray:
    try:
        return pattern_of(given)
    except ValueError as error:
        raise InputError(f"{where}: key 'mosaick_pattern' is {given}: {error}.") from error
