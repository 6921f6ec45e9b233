"""How a field plays a sensor file: what to render, and how that becomes the sensor's light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.scene import Sensor, canonical_modality
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.mosaic import crop_pattern
from mmsynth.sensors.sensor_file import SensorFile, find_sensor_file, load_sensor
from mmsynth.sensors.spectral import Combination, combine, require_expressible

if TYPE_CHECKING:
    from mmsynth.field.field import Field

VIRTUAL_SUPERSAMPLING = 2


@dataclass(frozen=True)
class SimulatedSensor:
    """How a field stands in for a sensor: what to render, and how that becomes the light on its pixels.

    Attributes:
        file: its figures, without those effects that the field has already. sensor: as a scene describes it. camera: None: of each view.
        to_reference: (4, 4) its place on the rig. modalities: of the field, to be rendered. supersampling: rays per pixel along each axis.
        light: rendered channels and Stokes vectors (H, W, ·) → (C, H, W) light, or (C, 3, H, W) Stokes vectors if ``polarized``.
        combinations: of virtual channels, by label.
    """

    file: SensorFile
    sensor: Sensor
    camera: Camera | None
    to_reference: np.ndarray
    modalities: tuple[str, ...]
    supersampling: int
    polarized: bool
    light: Callable[[dict[str, np.ndarray], dict[str, np.ndarray]], np.ndarray]
    combinations: dict[str, Combination]


def plan_sensor(field: Field, path: Path, *, delta: bool = False) -> SimulatedSensor:
    """Read a sensor file and decide how the field can simulate it.

    Args:
        delta: of an instance, apply the file's exposure, blur, vignetting, crosstalk and analysers on top of those that the field learned.
    Raises:
        InputError: bad file; a modality or channel that the field does not have; an effect that would be applied twice; a virtual channel
            that the measured ones cannot express.
    """
    file = load_sensor(path)
    return _instance(field, file, path, delta) if file.instance_of is not None else _virtual(field, file, path)


def _instance(field: Field, file: SensorFile, path: Path, delta: bool) -> SimulatedSensor:
    name = canonical_modality(file.instance_of or "")
    if name not in field.sensors:
        raise InputError(f"{path}: instance_of: {file.instance_of!r} is not in this field, expected one of {', '.join(field.sensors)}.")
    if name in field.predicted:
        raise InputError(
            f"{path}: instance_of: {name} is predicted by a prior, no sensor measured it; expected one of {', '.join(field.measured)}."
        )
    captured = field.sensors[name]
    stated = [c.label for c in file.channels]
    if stated and stated != list(captured.channels):
        raise InputError(f"{path}: channels are {', '.join(stated)}, expected those of {name}: {', '.join(captured.channels)}.")
    pattern = _pattern(file)
    if pattern is not None and not np.array_equal(pattern, np.zeros((1, 1)) if captured.mosaic is None else captured.mosaic):
        raise InputError(f"{path}: mosaic: {pattern.tolist()} is not that of {name} in this field, {_listed(captured.mosaic)}.")
    if not delta:
        for key in ("exposure", "psf_sigma_px", "vignetting", "cos4", "polarizer_angle_sd_deg"):
            if getattr(file, key) != SensorFile.model_fields[key].default:
                raise InputError(
                    f"{path}: {key}: the field learned from the frames of {name} and has its {key} already; leave it out, or say --delta "
                    "to apply it on top."
                )
        if file.noise.crosstalk:
            raise InputError(f"{path}: noise.crosstalk: the field has that of {name} already; leave it out, or say --delta.")
    polarized = delta and captured.is_polarization and any(c.polarizer for c in file.channels)

    def light(channels: dict[str, np.ndarray], stokes: dict[str, np.ndarray]) -> np.ndarray:
        if polarized:
            return np.broadcast_to(_stokes_light(file, stokes[name])[None], (len(file.channels), 3, *stokes[name].shape[:2]))
        return np.moveaxis(file.light_of(channels[name]), -1, 0)

    return SimulatedSensor(
        file=file,
        sensor=captured,
        camera=file.camera or field.cameras.get(name),
        to_reference=_place_on_rig(file, field.rig.get(name, np.eye(4))),
        modalities=(name,),
        supersampling=file.supersampling or 1,
        polarized=polarized,
        light=light,
        combinations={},
    )


def _virtual(field: Field, file: SensorFile, path: Path) -> SimulatedSensor:
    facts = {canonical_modality(f.instance_of): f for f in _measured(file, path) if f.instance_of is not None}
    for name, fact in facts.items():
        if name in field.sensors and [c.label for c in fact.channels] != list(field.sensors[name].channels):
            raise InputError(
                f"{path}: measured: the channels of {fact.name} are {', '.join(c.label for c in fact.channels)}, "
                f"expected those of {name} in this field: {', '.join(field.sensors[name].channels)}."
            )
    known = [
        ((name, i), c.response)
        for name, fact in facts.items()
        if name in field.sensors and not field.sensors[name].is_polarization
        for i, c in enumerate(fact.channels)
        if c.response is not None
    ]
    # each channel: weights of trained channels, or none where it is the polarization sensor's own light
    recipes: list[dict[tuple[str, int], float] | None] = []
    combinations = {}
    for c in file.channels:
        where = f"{path}: channels: {c.label}"
        if c.of is not None:
            recipes.append({_trained(field, c.of, where): 1.0})
        elif c.response is not None:
            if not known:
                raise InputError(f"{where}: none of the measured sensors ({', '.join(file.measured)}) is in this field with a response.")
            combination = combine(c.response, [r for _, r in known])
            require_expressible(combination, where)
            combinations[c.label] = combination
            recipes.append({key: float(w) for (key, _), w in zip(known, combination.weights, strict=True)})
        else:
            recipes.append(None)
    polarized = any(c.polarizer for c in file.channels)
    by = next((n for n, s in field.sensors.items() if s.is_polarization), None)
    if polarized and by is None:
        raise InputError(f"{path}: channels: polarizers need a field that learned from a polarization sensor, this one has none.")
    pattern = _pattern(file)

    def level(channels: dict[str, np.ndarray], weights: dict[tuple[str, int], float]) -> np.ndarray:
        of = lambda name: facts[name].light_of if name in facts else lambda value: value
        return np.asarray(sum(w * of(name)(channels[name][..., i]) for (name, i), w in weights.items()))

    def light(channels: dict[str, np.ndarray], stokes: dict[str, np.ndarray]) -> np.ndarray:
        if not polarized:
            return np.stack([level(channels, r) for r in recipes if r is not None])
        assert by is not None
        own = _stokes_light(facts[by], stokes[by]) if by in facts else np.moveaxis(stokes[by], -1, 0)
        polarized_part = np.divide(own, own[:1], out=np.zeros_like(own), where=own[:1] > 0)
        polarized_part[0] = 1.0
        return np.stack([own if r is None else level(channels, r) * polarized_part for r in recipes])

    used = {name for r in recipes if r is not None for name, _ in r} | ({by} if polarized and by is not None else set())
    peaks = [c.response.centre_nm if c.response is not None else None for c in file.channels]
    sensor = Sensor(
        name=canonical_modality(file.name),
        channels=tuple(c.label for c in file.channels),
        wavelengths_nm=tuple(peaks),
        mosaic=pattern if len(file.channels) > 1 else None,
        polarizer_angles_deg=tuple(c.polarizer.angle_deg for c in file.channels if c.polarizer) or None,
    )
    return SimulatedSensor(
        file=file,
        sensor=sensor,
        camera=file.camera,
        to_reference=_place_on_rig(file, np.eye(4)),
        modalities=tuple(n for n in field.sensors if n in used),
        supersampling=file.supersampling or VIRTUAL_SUPERSAMPLING,
        polarized=polarized,
        light=light,
        combinations=combinations,
    )


def _stokes_light(file: SensorFile, stokes: np.ndarray) -> np.ndarray:
    """(H, W, 3) of values → (3, H, W) of light: S0 is the sum of two intensities and holds the black level twice."""
    scale = file.dn_at_one / (file.noise.white_dn - file.noise.black_dn)
    black = np.array([2.0 * file.noise.black_dn / (file.noise.white_dn - file.noise.black_dn), 0.0, 0.0])
    return np.moveaxis(stokes * scale - black, -1, 0)


def _measured(file: SensorFile, path: Path) -> list[SensorFile]:
    captured = [(p, load_sensor(p)) for p in (find_sensor_file(name, path.parent) for name in file.measured)]
    for p, other in captured:
        if other.instance_of is None:
            raise InputError(f"{path}: measured: {p} is a virtual sensor, expected the file of a captured one (key 'instance_of').")
    return [other for _, other in captured]


def _trained(field: Field, of: str, where: str) -> tuple[str, int]:
    modality, _, label = of.partition(".")
    name = canonical_modality(modality)
    if name not in field.sensors or label not in field.sensors[name].channels:
        known = [f"{n}.{c}" for n, s in field.sensors.items() for c in s.channels]
        raise InputError(f"{where}: of: no trained channel {of!r}, expected one of {', '.join(known)}.")
    return name, field.sensors[name].channels.index(label)


def _pattern(file: SensorFile) -> np.ndarray | None:
    return None if file.mosaic is None else crop_pattern(np.array(file.mosaic, np.int64), file.mosaic_offset)


def _listed(mosaic: np.ndarray | None) -> Any:
    return "none" if mosaic is None else mosaic.tolist()


def _place_on_rig(file: SensorFile, default: np.ndarray) -> np.ndarray:
    return default if file.camera_to_reference is None else np.array(file.camera_to_reference)
