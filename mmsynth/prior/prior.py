"""A prior over scenes: learned from samples of several, kept in one file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.files import write_atomic
from mmsynth.prior.polarization import Polarization, inputs_of, learn_polarization
from mmsynth.prior.samples import SceneSamples, columns_of
from mmsynth.prior.spectra import Spectra, learn_spectra, white_of
from mmsynth.scene.scene import Sensor
from mmsynth.scene.serialisation import channels_to_json, sensor_from_json, sensor_to_json
from mmsynth.sensors.sensor_file import Response
from mmsynth.version import __version__

FORMAT = 1


@dataclass(frozen=True)
class Prior:
    """What scenes have in common.

    Attributes:
        sensors: the modalities it knows, by name. spectra: of all their channels.
        polarization: None where no scene had a polarization sensor. scenes: names of those it was learned from.
        responses: of its channels over wavelength, by modality, as far as sensor files were given; of polarization of S0 alone.
    """

    sensors: dict[str, Sensor]
    spectra: Spectra
    polarization: Polarization | None
    scenes: tuple[str, ...]
    responses: dict[str, tuple[Response | None, ...]] = field(default_factory=dict)

    @property
    def colour(self) -> np.ndarray:
        """Three columns that tell colours: the first, middle and last of the first modality with three channels or more, or fewer."""
        columns, indices = columns_of(self.sensors), np.arange(self.spectra.usual.shape[1])
        several = [name for name, sensor in self.sensors.items() if not sensor.is_polarization and sensor.channel_count >= 3]
        of = indices[columns[several[0]]] if several else indices
        return of[[0, len(of) // 2, len(of) - 1]]


def learn_prior(scenes: Sequence[SceneSamples], seed: int = 0) -> Prior:
    """Learn from samples of scenes; modalities of one name must have the same channels.

    Raises:
        InputError: no scenes, a scene with one modality, or two whose channels differ.
    """
    if not scenes:
        raise InputError("prior: no scenes, expected at least one with several modalities.")
    sensors: dict[str, Sensor] = {}
    for scene in scenes:
        if len(scene.sensors) < 2:
            raise InputError(
                f"{scene.name}: one modality ({', '.join(scene.sensors)}), expected several: a prior learns one from the other."
            )
        for name, sensor in scene.sensors.items():
            known = sensors.setdefault(name, sensor)
            if channels_to_json(known) != channels_to_json(sensor):
                raise InputError(
                    f"{scene.name}: {name} has the channels {described(sensor)}, and {described(known)} in {scenes[0].name}; "
                    "expected one name for one sensor: rename one of them."
                )
    spectra = learn_spectra(sensors, scenes, seed)
    prior = Prior(sensors, spectra, None, tuple(scene.name for scene in scenes))
    return Prior(sensors, spectra, _learn_polarization(prior, scenes, seed), prior.scenes)


def described(sensor: Sensor) -> str:
    """Labels and wavelengths of a sensor's channels, in words."""
    return ", ".join(
        label if wave is None else f"{label} ({wave:g} nm)" for label, wave in zip(sensor.channels, sensor.wavelengths_nm, strict=True)
    )


def _learn_polarization(prior: Prior, scenes: Sequence[SceneSamples], seed: int) -> Polarization | None:
    columns, colours = columns_of(prior.sensors), prior.colour
    inputs, wanted, levels = [], [], []
    for scene in scenes:
        name = next((n for n, s in scene.sensors.items() if s.is_polarization), None)
        if name is None or scene.polarized is None or scene.shapes is None:
            continue
        white = white_of(prior.spectra, columns, list(scene.body), scene)
        body = np.full((len(scene.images), prior.spectra.usual.shape[1]), np.nan)
        for other, light in scene.body.items():
            body[:, columns[other]] = light / np.exp(white.log[columns[other]])
        level = np.nanmean(body)
        colour, unit = body[:, colours], lamp_unit(scene, columns, white.log)
        if not np.isfinite(colour).all():
            continue  # no colours in this scene
        images = scene.images * unit * np.exp(white.log[columns[name]])  # (N, 3), in the units of the polarization sensor
        s0 = scene.body[name][:, 0] + images[:, 0]
        left = torch.from_numpy(scene.polarized - images[:, 1:]).float()
        q = (left * scene.shapes.turn).sum(1) / torch.from_numpy(s0).float().clamp(min=1e-6)
        of = lambda values: torch.from_numpy(np.ascontiguousarray(values)).float()
        inputs.append(inputs_of(of(colour / level), of(scene.images[:, 0] * unit / level), scene.shapes))
        wanted.append(q.clamp(-1.0, 1.0))
        levels.append(of(s0 / max(s0.mean(), 1e-12)))
    return learn_polarization(torch.cat(inputs), torch.cat(wanted), torch.cat(levels), seed) if inputs else None


def lamp_unit(scene: SceneSamples, columns: dict[str, slice], white: np.ndarray) -> float:
    """A lamp's spectrum, as ``SceneSamples`` has it, over white (log, (C,)): a number, as white is the lamps', up to one factor."""
    if scene.lamp is None:
        return 0.0
    logs = [np.log(np.maximum(value, 1e-12)) - white[columns[name]] for name, value in scene.lamp.items()]
    return float(np.exp(np.concatenate(logs).mean()))


def save_prior(prior: Prior, path: Path) -> None:
    """Write a prior as one safetensors file, atomically; what it is stands in its header."""
    tensors = {f"spectra.{k}": torch.from_numpy(np.ascontiguousarray(v, dtype=np.float32)) for k, v in _arrays(prior.spectra).items()}
    net = prior.polarization
    if net is not None:
        tensors |= {"polarization.centre": net.centre, "polarization.scale": net.scale}
        tensors |= {f"polarization.weights.{i}": weight.contiguous() for i, weight in enumerate(net.weights)}
    about = {
        "format": FORMAT,
        "mmsynth": __version__,
        "sensors": [sensor_to_json(sensor) for sensor in prior.sensors.values()],
        "scenes": list(prior.scenes),
        "responses": {
            name: [None if r is None else r.model_dump(exclude_defaults=True) for r in of] for name, of in prior.responses.items()
        },
    }
    content = save(tensors, {"prior": json.dumps(about)})
    write_atomic(path, lambda temporary: temporary.write_bytes(content))


def load_prior(path: Path) -> Prior:
    """Read a prior.

    Raises:
        InputError: no such file, or it is broken, or no prior of this version.
    """
    try:
        with safe_open(path, "pt") as file:
            about: dict[str, Any] = json.loads((file.metadata() or {})["prior"])
            tensors: dict[str, Tensor] = {key: file.get_tensor(key) for key in file.keys()}
        if about["format"] != FORMAT:
            raise InputError(f"{path}: a prior of format {about['format']}, expected {FORMAT}: made by another version of mmsynth.")
        arrays = {key.removeprefix("spectra."): t.double().numpy() for key, t in tensors.items() if key.startswith("spectra.")}
        weights = tuple(tensors[f"polarization.weights.{i}"] for i in range(6)) if "polarization.centre" in tensors else None
        return Prior(
            {s["name"]: sensor_from_json(s) for s in about["sensors"]},
            Spectra(**arrays, scenes=len(about["scenes"])),
            None if weights is None else Polarization(tensors["polarization.centre"], tensors["polarization.scale"], weights),
            tuple(about["scenes"]),
            {name: tuple(None if r is None else Response(**r) for r in of) for name, of in about["responses"].items()},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a prior of mmsynth ({error}).") from error
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file, expected a prior, as `mmsynth prior` writes it, or 'default'.") from error
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: could not be read as a prior ({str(error).splitlines()[0]}).") from error


def _arrays(spectra: Spectra) -> dict[str, np.ndarray]:
    return {f.name: getattr(spectra, f.name) for f in fields(Spectra) if f.name != "scenes"}
