"""Modalities that nobody measured in a scene, from those that somebody did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.prior.correction import Correction, choose_lengths, choose_points, gain_of, learn, places_of
from mmsynth.prior.polarization import inputs_of
from mmsynth.prior.prior import Prior, described, lamp_unit
from mmsynth.prior.samples import SceneSamples, Shapes, columns_of
from mmsynth.prior.spectra import SpectralMap, White, spectral_map, white_of
from mmsynth.scene.exposure import Exposure
from mmsynth.scene.scene import Sensor
from mmsynth.scene.serialisation import channels_to_json
from mmsynth.sensors.polarization import stokes_to_intensities


@dataclass(frozen=True)
class SceneFacts:
    """What of a scene its predictions rest on; ready for JSON.

    Attributes:
        known: modalities that predictions are made of. white: log of what a white board shows in each of the prior's channels.
        white_deviation: of it. free: modalities whose gain nobody stated: their level is what is usual. how: where white is from.
        level: mean of the scene's reflected light. lamp: a lamp's spectrum over white. error: of the field in each known channel, 1.0 =
            full
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
class Seen:
    """What a field shows along R rays.

    Attributes:
        body: per known modality, light without the images of lamps, (R, C), of polarization S0, (R, 1); 1.0 = full scale.
        images: (R, 3) Stokes vectors of the images of lamps, in units of their mean spectrum.
        shapes: of the surfaces met, None: polarization is that of lamps alone. position: (R, 3) of these, normalised frame.
    """

    body: Mapping[str, Tensor]
    images: Tensor
    shapes: Shapes | None
    position: Tensor


@dataclass(frozen=True)
class Prediction:
    """A prior, made ready for one scene.

    Attributes:
        sensors: the predicted modalities. facts: of the scene. corrections: what frames of them add, by modality.
    """

    sensors: dict[str, Sensor]
    facts: SceneFacts
    prior: Prior
    spectra: SpectralMap
    given: np.ndarray
    wanted: np.ndarray
    corrections: dict[str, Correction] = field(default_factory=dict)

    def __call__(self, seen: Seen) -> dict[str, Predicted]:
        """Predict every modality along R rays."""
        facts, columns = self.facts, columns_of(self.prior.sensors)
        given, reflected, places = self._known(seen)
        mean = reflected.mean(1, keepdim=True)
        value, paint = self.spectra(given)
        error = given.new_tensor(facts.error)
        of_field = (error[:, None] / self.spectra.known[:, None] * self.spectra.linear * self.spectra.wanted).square().sum(0)
        white, of_white = torch.exp(given.new_tensor(facts.white)), given.new_tensor(facts.white_deviation)
        out = {}
        for name, sensor in self.sensors.items():
            column, at, correction = columns[name], self._at(name), self.corrections.get(name)
            light, spread, level = value[:, at], paint[:, at], of_white[column]
            lamps = seen.images * facts.lamp
            more = unsure = None
            if correction is not None:
                more, unsure = correction(places)
                count = light.shape[1]
                light = (correction.gain * light + mean * white[column] * more[:, :count]).clamp(min=0.0)
                lamps, spread, level = correction.gain * lamps, spread * unsure[:, :count], torch.zeros_like(level)
            of_lamps = lamps[:, :1] * white[column]
            deviation = torch.sqrt(spread.square() + of_field[at] + ((light + of_lamps) * level).square())
            if not sensor.is_polarization:
                out[name] = Predicted(light + of_lamps, deviation, of_lamps)
                continue
            whole = given.new_zeros(len(given), len(white))
            whole[:, self.given], whole[:, self.wanted] = given, value
            q, of_q = self._polarization(whole / white / facts.level, seen)
            if more is not None and unsure is not None:
                q, of_q = (q + more[:, -1]).clamp(-1.0, 1.0), of_q * unsure[:, -1]
            out[name] = _polarized(sensor, light[:, 0], lamps * white[column], q, seen.shapes, deviation, of_q)
        return out

    def _at(self, name: str) -> np.ndarray:
        """Where the channels of a modality stand among the wanted."""
        column = columns_of(self.prior.sensors)[name]
        return np.flatnonzero((self.wanted >= column.start) & (self.wanted < column.stop))

    def _known(self, seen: Seen) -> tuple[Tensor, Tensor, Tensor]:
        """Light and reflected light of the known channels, (R, A), and places of the surfaces, (R, Z)."""
        given = torch.cat([seen.body[name].clamp(min=0.0) for name in self.facts.known], 1)
        reflected = given / self.spectra.known
        return given, reflected, places_of(reflected, seen.position, self.facts.level)

    def _polarization(self, reflected: Tensor, seen: Seen) -> tuple[Tensor, Tensor]:
        net, images = self.prior.polarization, seen.images[:, 0] * self.facts.lamp / self.facts.level
        if net is None or seen.shapes is None:
            return torch.zeros_like(images), torch.full_like(images, _UNKNOWN_Q)
        return net(inputs_of(reflected[:, self.prior.colour], images, seen.shapes))

    def corrected(self, name: str, seen: Seen, channel: Tensor, measured: Tensor, frames: int) -> Prediction:
        """With what N numbers add that were measured by the modality ``name`` along N rays.

        Args:
            channel: (N,) int64 of each number. measured: (N,), 1.0 = full scale. frames: that they are of.
        """
        column, at = columns_of(self.prior.sensors)[name], self._at(name)
        _, reflected, places = self._known(seen)
        found = self(seen)[name]
        predicted = found.light.gather(1, channel[:, None])[:, 0]
        gain = gain_of(predicted, measured, float(np.mean(self.facts.white_deviation[column])))
        rest = measured - gain * predicted
        white = torch.exp(torch.tensor(self.facts.white[column]))
        level = reflected.mean(1)
        sizes = self.spectra.base[at].sqrt()
        points = choose_points(places)
        angles = self.sensors[name].polarizer_angles_deg
        left = rest.clone()
        if angles is not None and found.stokes is not None:
            turned = torch.deg2rad(2.0 * torch.tensor(angles))[channel]
            turn = torch.zeros(len(channel), 2) if seen.shapes is None else seen.shapes.turn
            along = turn[:, 0] * torch.cos(turned) + turn[:, 1] * torch.sin(turned)
            parts = 0.5 * torch.stack([level * white[0], found.stokes[:, 0] * along], 1)
            groups = [torch.arange(len(channel))]
            of_channels = [(places, parts, torch.cat([sizes, sizes.new_tensor([_UNSURE_Q])]), rest)]
        else:
            groups = [torch.nonzero(channel == c)[:, 0] for c in range(len(white))]
            each = zip(groups, white, sizes, strict=True)
            of_channels = [(places[rows], (level[rows] * w)[:, None], size[None], rest[rows]) for rows, w, size in each]
        lengths = choose_lengths(points, of_channels)
        learned = []
        for rows, of_channel in zip(groups, of_channels, strict=True):
            *tensors, left[rows] = learn(points, of_channel, lengths)
            learned.append(tensors)
        weights, unknown = (torch.cat(parts) for parts in zip(*learned, strict=True))
        rms = lambda values: float(values.square().mean().sqrt())
        made = Correction(gain, points, weights, unknown, lengths, frames, rms(measured - predicted), rms(left))
        return replace(self, corrections={**self.corrections, name: made})


_UNKNOWN_Q = 0.1  # deviation of q where nothing tells it
_UNSURE_Q = 0.03  # by which materials of a scene differ from what the network expects


def _polarized(sensor: Sensor, body: Tensor, lamps: Tensor, q: Tensor, shapes: Shapes | None, deviation: Tensor, of_q: Tensor) -> Predicted:
    """S0 of the body (R,), Stokes vectors of the lamps' images (R, 3) and q (R,) → what a polarization sensor shows."""
    assert sensor.polarizer_angles_deg is not None
    s0 = body + lamps[:, 0]
    polarized = lamps[:, 1:] if shapes is None else lamps[:, 1:] + (s0 * q)[:, None] * shapes.turn
    much = torch.linalg.vector_norm(polarized, dim=1)
    polarized = polarized * torch.where(much > s0, s0 / much, torch.ones_like(s0))[:, None]
    stokes = torch.cat([s0[:, None], polarized], 1)
    # I = (S0 + S1 cos 2a + S2 sin 2a) / 2
    behind = 0.5 * torch.sqrt(deviation.square() + (s0 * of_q)[:, None].square())
    angles = sensor.polarizer_angles_deg
    return Predicted(
        stokes_to_intensities(stokes, angles), behind.expand(-1, len(angles)), stokes_to_intensities(lamps, angles), stokes, lamps[:, 0]
    )


def scene_facts(prior: Prior, sample: SceneSamples, error: Mapping[str, float]) -> SceneFacts:
    """What a scene's samples say.

    Args:
        sample: of its modalities, those that the prior does not know included. error: of the field, rms, by modality, 1.0 = full scale.
    Raises:
        InputError: scene and prior have no channels in common.
    """
    known = common(prior, sample.sensors)
    columns = columns_of(prior.sensors)
    white = white_of(prior.spectra, columns, known, sample, _lit(prior, sample.exposure))
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


def _lit(prior: Prior, exposure: Exposure) -> np.ndarray | None:
    """``lit`` of ``white_of``: the stated lamp through the responses of the prior's channels; of a dark channel nothing."""
    if exposure.lamp is None:
        return None
    columns = columns_of(prior.sensors)
    out = np.full(prior.spectra.usual.shape[1], np.nan)
    for name, responses in prior.responses.items():
        for i, response in zip(range(columns[name].start, columns[name].stop), responses, strict=True):
            if response is not None:
                step = min(1.0, response.detail_nm() / 4.0)
                nm = np.arange(*response.range_nm(), step)
                light = float((response.at(nm) * exposure.lamp.at(nm)).sum() * step)
                out[i] = np.log(light) if light > 0 else np.nan
    return out


def common(prior: Prior, sensors: Mapping[str, Sensor]) -> list[str]:
    """Modalities with the same channels in a scene and in a prior. Raises InputError: none."""
    out = [n for n, sensor in sensors.items() if n in prior.sensors and channels_to_json(sensor) == channels_to_json(prior.sensors[n])]
    if not out:
        raise InputError(
            f"prior: it knows {_listed(prior.sensors)}; the scene has {_listed(sensors)}; "
            f"expected a modality with the same channels in both."
        )
    return out


def _listed(sensors: Mapping[str, Sensor]) -> str:
    return "; ".join(f"{name}: {described(sensor)}" for name, sensor in sensors.items())


def predict(prior: Prior, facts: SceneFacts, measured: Sequence[str]) -> Prediction:
    """Make a prior ready for a scene that has the modalities ``measured``: all others that a scene of the prior had beside them are
    predicted."""
    columns, indices = columns_of(prior.sensors), np.arange(prior.spectra.usual.shape[1])
    given = np.concatenate([indices[columns[name]] for name in facts.known])
    # of what no scene had beside the known, nothing is known
    met = np.isfinite(prior.spectra.moments[given]).all(0)
    rest = np.setdiff1d(indices[met], given)
    free = np.isin(indices, [i for name in facts.free for i in indices[columns[name]]])
    white = White(np.array(facts.white), np.array(facts.white_deviation), free, facts.how)
    sensors = {name: sensor for name, sensor in prior.sensors.items() if name not in measured and met[columns[name]].all()}
    return Prediction(sensors, facts, prior, spectral_map(prior.spectra, white, given, rest), given, rest)
