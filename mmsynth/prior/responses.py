"""A prior of one rig, for the channels of another: by what their sensor files say of responses over wavelength.

A channel of the other rig is a combination of the prior's (``sensors.spectral``), as far as these see its wavelengths. Statistics of
combinations follow from those of what is combined: light adds up, reflected light as white does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mmsynth.errors import InputError
from mmsynth.prior.prior import Prior
from mmsynth.prior.samples import columns_of
from mmsynth.prior.spectra import Spectra
from mmsynth.scene.scene import Sensor, canonical_modality
from mmsynth.scene.serialisation import channels_to_json
from mmsynth.sensors.sensor_file import Response, SensorFile
from mmsynth.sensors.spectral import combine, require_expressible


def responses_of(file: SensorFile, sensor: Sensor) -> tuple[Response | None, ...]:
    """Of the channels of a captured sensor, None where nothing is said; of a polarization sensor one, of S0.

    Raises:
        InputError: the file is of other channels.
    """
    labels = tuple(c.label for c in file.channels)
    if labels != sensor.channels:
        raise InputError(f"{file.name}: channels are {', '.join(labels)}, expected those of {sensor.name}: {', '.join(sensor.channels)}.")
    found = tuple(c.response for c in file.channels)
    return found[:1] if sensor.is_polarization else found


def with_responses(prior: Prior, files: Sequence[SensorFile]) -> Prior:
    """The prior, with what files of captured sensors (``instance_of``) say of its modalities' responses.

    Raises:
        InputError: a file of no modality of the prior, or of other channels.
    """
    out = dict(prior.responses)
    for file in files:
        name = canonical_modality(file.instance_of or "")
        if name not in prior.sensors:
            raise InputError(
                f"{file.name}: instance_of: {file.instance_of!r} is not in the prior, expected one of {', '.join(prior.sensors)}."
            )
        out[name] = responses_of(file, prior.sensors[name])
    return replace(prior, responses=out)


def for_sensors(prior: Prior, sensors: Mapping[str, Sensor], files: Sequence[SensorFile]) -> Prior:
    """The prior for a scene whose ``sensors`` are others: each that a file describes takes the place of the prior's of its name.

    Raises:
        InputError: the prior's responses are not known, or a file says nothing of some channel's, or the prior's channels do not see the
            wavelengths of one of the scene's; the sentence names these.
    """
    for file in files:
        name = canonical_modality(file.instance_of or "")
        if name not in sensors:
            raise InputError(f"{file.name}: instance_of: {file.instance_of!r} is not in the scene, expected one of {', '.join(sensors)}.")
        same = name in prior.sensors and channels_to_json(prior.sensors[name]) == channels_to_json(sensors[name])
        if same and prior.responses.get(name) == responses_of(file, sensors[name]):
            continue
        prior = _with_modality(prior, sensors[name], responses_of(file, sensors[name]))
    return prior


def _with_modality(prior: Prior, sensor: Sensor, responses: tuple[Response | None, ...]) -> Prior:
    """The prior with a modality of these responses in the place of its own of that name, or after all others."""
    if not prior.responses:
        raise InputError("prior: it was made without sensor files, so its responses are not known; expected some, to combine its channels.")
    columns, count = columns_of(prior.sensors), prior.spectra.usual.shape[1]
    indices = np.arange(count)
    of_channels = [(i, r) for name, of in prior.responses.items() for i, r in zip(indices[columns[name]], of, strict=True) if r is not None]
    seen, measured = np.array([i for i, _ in of_channels]), [r for _, r in of_channels]
    a = np.where(np.isfinite(prior.spectra.line[0]), prior.spectra.line[0], prior.spectra.raw[0])
    sensors = {**prior.sensors, sensor.name: sensor}
    rows, white = [], []
    for name in sensors:
        if name != sensor.name:
            rows.append(np.eye(count)[columns[name]])
            white.append(a[columns[name]])
            continue
        for label, response in zip(sensor.channels, responses, strict=False):
            if response is None:
                raise InputError(
                    f"prior: {sensor.name}.{label}: its sensor file says nothing of its response, expected one of every channel."
                )
            combination = combine(response, measured)
            require_expressible(combination, f"prior: {sensor.name}.{label}")
            light = np.zeros(count)
            light[seen] = combination.weights * np.exp(a[seen])  # of white
            rows.append(light[None] / light.sum())
            white.append(np.log([light.sum()]))
    return replace(
        prior,
        sensors=sensors,
        spectra=_mixed(prior.spectra, np.concatenate(rows), np.concatenate(white)),
        responses={**prior.responses, sensor.name: responses},
    )


def _mixed(spectra: Spectra, mix: np.ndarray, white: np.ndarray) -> Spectra:
    """Statistics of mixtures (D, C) of channels; ``white``: (D,) log of theirs over gain."""

    def mixed(values: np.ndarray, how: np.ndarray) -> np.ndarray:
        """(K, C) → (K, D), NaN where a part is."""
        lacks = ~np.isfinite(values) @ (how != 0).T
        return np.where(lacks, np.nan, np.where(np.isfinite(values), values, 0.0) @ how.T)

    return replace(
        spectra,
        moments=mixed(mixed(spectra.moments, mix).T, mix).T,
        usual=np.stack([np.log(np.maximum(mix @ np.exp(spectra.usual[0]), 1e-12)), np.abs(mix) @ spectra.usual[1]]),
        mean=mixed(spectra.mean, mix),
        spread=mixed(spectra.spread, mix**2),
        line=np.stack([white, mix @ spectra.line[1], np.abs(mix) @ spectra.line[2]]),
        raw=np.stack([white, np.abs(mix) @ spectra.raw[1]]),
    )
