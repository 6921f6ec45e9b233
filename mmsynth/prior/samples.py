"""What a prior is learned from: light of several modalities on the same rays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mmsynth.scene.exposure import Exposure
from mmsynth.scene.scene import Sensor


@dataclass(frozen=True)
class Shapes:
    """Surfaces that N rays meet.

    Attributes:
        cosine: (N,) of the angle between normal and viewer, in [0, 1]. turn: (N, 2), cos 2a and sin 2a of the angle a from the first
            reference axis to the plane of view and normal. roughness, strength: (N,) of the surface as a mirror, 0 where nothing shines.
    """

    cosine: Tensor
    turn: Tensor
    roughness: Tensor
    strength: Tensor


def shapes_of(normals: Tensor, directions: Tensor, x: Tensor, y: Tensor, roughness: Tensor, strength: Tensor) -> Shapes:
    """Of surfaces with unit ``normals`` (N, 3), seen along ``directions``, about the reference axes x, y (N, 3) of the rays."""
    on_x, on_y = (normals * x).sum(-1), (normals * y).sum(-1)  # the axes are perpendicular to the ray
    square = on_x.square() + on_y.square()
    turn = torch.stack([on_x.square() - on_y.square(), 2.0 * on_x * on_y], -1) / square.clamp(min=1e-12)[:, None]
    head_on = (square < 1e-12)[:, None]  # no plane, and no polarization
    return Shapes(
        cosine=-(normals * directions).sum(-1).clamp(-1.0, 0.0),
        turn=torch.where(head_on, torch.zeros_like(turn), turn),
        roughness=roughness,
        strength=strength,
    )


@dataclass(frozen=True)
class SceneSamples:
    """N rays of one scene.

    Attributes:
        name: of the scene. sensors: its modalities. exposure: what is stated of them.
        body: (N, C) per modality, light without the images of lamps, 1.0 = full scale; of a polarization modality S0 alone, (N, 1).
        lamp: (C,) per modality, mean spectrum of the lamps that surfaces mirror, up to one factor; None where none is known.
        images: (N, 3) Stokes vectors of the images of lamps, in units of that spectrum.
        polarized: (N, 2) S1, S2 of the polarization modality, the images of lamps included, with ``shapes``; None where none is measured.
    """

    name: str
    sensors: Mapping[str, Sensor]
    exposure: Exposure
    body: Mapping[str, np.ndarray]
    lamp: Mapping[str, np.ndarray] | None
    images: np.ndarray
    polarized: np.ndarray | None = None
    shapes: Shapes | None = None


def column_count(sensor: Sensor) -> int:
    """How many numbers describe its unpolarized light."""
    return 1 if sensor.is_polarization else sensor.channel_count


def columns_of(sensors: Mapping[str, Sensor]) -> dict[str, slice]:
    """Where each modality's channels stand in a vector of all of them."""
    out, start = {}, 0
    for name, sensor in sensors.items():
        out[name] = slice(start, start + column_count(sensor))
        start = out[name].stop
    return out
