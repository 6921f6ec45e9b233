"""What is kept of a field beside its parameters: sizes of its parts, and by how far poses were off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Corrections:
    """Rigid motions by which a fit found the input's poses to be off; scene unit.

    Attributes:
        views: by view id, (4, 4), applied in the world frame. sensors: by name, (4, 4), applied in the camera's axes.
    """

    views: dict[int, np.ndarray]
    sensors: dict[str, np.ndarray]


@dataclass(frozen=True)
class Design:
    """The sizes of a field's parts: what a scene was found to need (see fitting.needs). Stored with the field."""

    surface_levels: int = 8
    surface_rows_log2: int | tuple[int, ...] = 16
    surface_finest: int = 128
    radiance_levels: int = 10
    radiance_rows_log2: int | tuple[int, ...] = 16
    radiance_finest: int = 256
    background: bool = False
    far_light: bool = False
    light: bool = False
    outer_radius: float = 1.9
    surface_hidden: int = 32
    radiance_hidden: int = 64
    coarsest: int = 16
    occupancy: int = 64
    initial_radius: float = 0.5
