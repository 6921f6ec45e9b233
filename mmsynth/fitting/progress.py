"""How far a fit is: its counters, and the news of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from mmsynth.fitting.choices import Choice
from mmsynth.fitting.decisions import Decisions
from mmsynth.fitting.table_sizes import TableSizes


@dataclass(frozen=True)
class FitProgress:
    """One line of news: ``done`` in [0, 1], running means of loss and PSNR [dB] per modality, speeds over the fit."""

    step: int
    done: float
    elapsed: float
    loss: float
    psnr: dict[str, float]
    rays_per_s: float
    samples_per_s: float


@dataclass
class FitState:
    """The counters of a fit, and what was decided in it; ``rays``, ``rays_after``: of the next step and the one after it, ``reopened``: how
    often the occupancy grid was."""

    step: int = 0
    elapsed: float = 0.0
    rays: int = 0
    rays_after: int = 0
    rays_total: int = 0
    samples_total: int = 0
    bad_steps: int = 0
    reopened: int = 0
    tables: TableSizes | None = None
    light_looks: int = 0
    light: Choice[bool] | None = None
    decided: Decisions | None = None
    mean_loss: float = math.nan
    mean_error: dict[str, float] = field(default_factory=dict)
