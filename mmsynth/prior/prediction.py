"""Modalities that nobody measured in a scene, from those that somebody did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.prior.polarization import Polarization, inputs_of
from mmsynth.prior.prior import Prior, described, lamp_unit
from mmsynth.prior.samples import SceneSamples, Shapes, columns_of
from mmsynth.prior.spectra import SpectralMap, White, spectral_map, white_of
from mmsynth.scene.scene import Sensor
from mmsynth.scene.serialisation import channels_to_json
from mmsynth.sensors.polarization import stokes_to_intensities


@dataclass(frozen=True)
class SceneFacts:
    """What of a scene its predictions rest on; ready for JSON.

    Attributes:
        known: modalities that predictions are made of. white: log of what a white board shows in each of the prior's channels.
        white_deviation: of it. free: modalities whose gain nobody stated: their level is what is usual. how: where white is from.
        level: mean of the scene's reflected light. lamp: a lamp's spectrum over white. error: of the field in each known channel, 1.0 = full
            scale.
    """

    known: tuple[str, ...]
    white: tuple[float, ...]
    white_deviation: tuple[float, ...]
    free: tuple[str, ...]
    how: str
    level: float
    lamp: float
    error: tuple[float, ...]

    @classmethod
    def from_json(cls, stated: Mapping[str, Any]) -> SceneFacts:
        """What ``asdict`` gave."""
        values: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in stated.items()}
        return cls(**values)


@dataclass(frozen=True)
class Predicted:
    """Of R rays.

    Attributes:
        light: (R, C), behind the analysers of a polarization sensor; 1.0 = full scale. deviation: (R, C) of it.
        stokes: (R, 3) about the rays' reference axes, of a polarization sensor. images: (R, C) and images_s0: (R,) the part of it that are
            images of lamps.
    """

    light: Tensor
    deviation: Tensor
    images: Tensor
    stokes: Tensor | None = None
    images_s0: Tensor | None = None


@dataclass(frozen=True)
class Prediction:
    """A prior, made ready for one scene.

    Attributes:
        sensors: the predicted modalities. facts: of the scene.
    """

    sensors: dict[str, Sensor]
    facts: SceneFacts
    prior: Prior
    _map: SpectralMap
    _given: np.ndarray
    _wanted: np.ndarray

    def __call__(self, body: Mapping[str, Tensor], images: Tensor, shapes: Shapes | None) -> dict[str, Predicted]:
        """Predict every modality along R rays.

        Args:
            body: per known modality, light without the images of lamps, (R, C), of polarization S0, (R, 1). images: (R, 3) Stokes vectors of
                the images of lamps, in units of their mean spectrum. shapes: of the surfaces met, None: polarization is that of lamps alone.
        """
        columns, facts = columns_of(self.prior.sensors), self.facts
        given = torch.cat([body[name].clamp(min=0.0) for name in facts.known], 1)
        value, deviation = self._map(given)
        of_field = (given.new_tensor(facts.error)[:, None] / self._map.known[:, None] * self._map.linear * self._map.wanted).square().sum(0)
        of_white = given.new_tensor(facts.white_deviation)[self._wanted]
        white = torch.exp(given.new_tensor(facts.white))
        whole = given.new_empty(len(given), len(white))
        whole[:, self._given], whole[:, self._wanted] = given, value
        deviations = whole.new_zeros(whole.shape)
        deviations[:, self._wanted] = torch.sqrt(deviation.square() + of_field + (value * of_white).square())
        of_lamps = images[:, :1] * facts.lamp * white
        out = {}
        for name, sensor in self.sensors.items():
            column = columns[name]
            light, lamps = whole[:, column], of_lamps[:, column]
            # as unsure as of white is one of the lamps, too
            spread = torch.sqrt(deviations[:, column].square() + (lamps * given.new_tensor(facts.white_deviation)[column]).square())
            if not sensor.is_polarization:
                out[name] = Predicted(light + lamps, spread, lamps)
                continue
            reflected = whole / white / facts.level
            q, q_deviation = self._polarization(reflected, images[:, 0] * facts.lamp / facts.level, shapes)
            s0 = light[:, 0] + lamps[:, 0]
            polarized = images[:, 1:] * facts.lamp * white[column]
            polarized = polarized + (s0 * q)[:, None] * (torch.zeros_like(polarized) if shapes is None else shapes.turn)
            much = torch.linalg.vector_norm(polarized, dim=1)
            polarized = polarized * torch.where(much > s0, s0 / much, torch.ones_like(s0))[:, None]
            stokes = torch.cat([s0[:, None], polarized], 1)
            assert sensor.polarizer_angles_deg is not None
            # I = (S0 + S1 cos 2a + S2 sin 2a) / 2
            turned = 0.5 * torch.sqrt(spread.square() + (s0 * q_deviation)[:, None].square())
            out[name] = Predicted(
                stokes_to_intensities(stokes, sensor.polarizer_angles_deg),
                turned.expand(-1, sensor.channel_count),
                stokes_to_intensities(torch.cat([lamps, images[:, 1:] * facts.lamp * white[column]], 1), sensor.polarizer_angles_deg),
                stokes,
                lamps[:, 0],
            )
        return out

    def _polarization(self, reflected: Tensor, images: Tensor, shapes: Shapes | None) -> tuple[Tensor, Tensor]:
        net: Polarization | None = self.prior.polarization
        if net is None or shapes is None:
            return torch.zeros_like(images), torch.full_like(images, 0.1)
        return net(inputs_of(reflected[:, self.prior.colour], images, shapes))


def scene_facts(prior: Prior, sample: SceneSamples, error: Mapping[str, float]) -> SceneFacts:
    """What a scene's samples say.

    Args:
        sample: of its modalities, those that the prior does not know included. error: of the field, rms, by modality, 1.0 = full scale.
    Raises:
        InputError: scene and prior have no channels in common.
    """
    known = common(prior, sample.sensors)
    columns = columns_of(prior.sensors)
    white = white_of(prior.spectra, columns, known, sample)
    kept = {name: sample.body[name] for name in known}
    reflected = [light / np.exp(white.log[columns[name]]) for name, light in kept.items()]
    level = float(np.concatenate(reflected, 1).mean())
    lamp = None if sample.lamp is None else {name: sample.lamp[name] for name in known}
    only = SceneSamples(sample.name, {n: sample.sensors[n] for n in known}, sample.exposure, kept, lamp, sample.images)
    free = tuple(name for name in prior.sensors if name not in sample.sensors and bool(white.free[columns[name]].any()))
    errors = [error[name] for name in known for _ in range(columns[name].stop - columns[name].start)]
    return SceneFacts(
        known=tuple(known),
        white=tuple(map(float, white.log)),
        white_deviation=tuple(map(float, white.deviation)),
        free=free,
        how=white.how,
        level=max(level, 1e-12),
        lamp=lamp_unit(only, columns, white.log),
        error=tuple(errors),
    )


def common(prior: Prior, sensors: Mapping[str, Sensor]) -> list[str]:
    """Modalities with the same channels in a scene and in a prior. Raises InputError: none."""
    out = [n for n, sensor in sensors.items() if n in prior.sensors and channels_to_json(sensor) == channels_to_json(prior.sensors[n])]
    if not out:
        raise InputError(
            f"prior: it knows {_listed(prior.sensors)}; the scene has {_listed(sensors)}; expected a modality with the same channels in both."
        )
    return out


def _listed(sensors: Mapping[str, Sensor]) -> str:
    return "; ".join(f"{name}: {described(sensor)}" for name, sensor in sensors.items())


def predict(prior: Prior, facts: SceneFacts, measured: Sequence[str]) -> Prediction:
    """Make a prior ready for a scene that has the modalities ``measured``: all others of the prior are predicted."""
    columns, indices = columns_of(prior.sensors), np.arange(len(prior.spectra.usual))
    given = np.concatenate([indices[columns[name]] for name in facts.known])
    rest = np.setdiff1d(indices, given)
    free = np.isin(indices, [i for name in facts.free for i in indices[columns[name]]])
    white = White(np.array(facts.white), np.array(facts.white_deviation), free, facts.how)
    sensors = {name: sensor for name, sensor in prior.sensors.items() if name not in measured}
    return Prediction(sensors, facts, prior, spectral_map(prior.spectra, white, given, rest), given, rest)
