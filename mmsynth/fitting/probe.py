"""What residuals say in the middle of a fit: how far radiance depends on the direction, and whether frames were exposed differently.

Rays of all frames are compared with what was measured. Half of them may be learned from, the other half judges.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.radiance import Shader
from mmsynth.fitting.measurements import Batch
from mmsynth.fitting.optimiser import Adam

DEGREES = 3  # of spherical harmonics
_STEPS = 40
_RATE = 4e-3


@dataclass(frozen=True)
class Residuals:
    """Predicted and measured numbers of one modality, (N,) each, in units of its level, clipped ones left out; frame: (N,) index."""

    predicted: np.ndarray
    target: np.ndarray
    frame: np.ndarray


def errors_by_degree(shader: Shader, features: Tensor, opacity: Tensor, batch: Batch) -> dict[str, list[float]]:
    """Mean squared error of each modality with directions up to degree 0, 1, ... ``DEGREES``, at rays that were not learned from.

    Copies of the shader, one per degree, go on learning for some steps from the rays of even number, geometry and appearance
    held fixed: one that can do without directions has learned to by then. (Asking only what the shader loses when directions are
    taken from it would not tell: it uses what it is given, needed or not.)

    Args:
        features: (R, F). opacity: (R,). batch: the R rays and what was measured along them.
    Returns:
        by modality; NaN where every number is clipped.
    """
    learned = batch.ray % 2 == 0
    usable = batch.target < batch.saturation
    out: dict[str, list[float]] = {name: [] for name in batch.parts}
    for degree in range(DEGREES + 1):
        pupil = copy.deepcopy(shader)
        parameters = dict(pupil.named_parameters())
        optimiser = Adam(parameters, dict.fromkeys(parameters, _RATE))
        for step in range(_STEPS + 1):
            with torch.enable_grad():
                predicted = kernels.predict(pupil(features, batch.directions, degree), opacity, batch.measured)
                difference = kernels.residual(predicted, batch.measured)
                if step < _STEPS:
                    kernels.photometric(difference * learned, batch.measured).backward()
                    optimiser.step(1.0 - step / _STEPS)
        for name, (_, numbers) in batch.parts.items():
            judged = (~learned & usable)[numbers]
            out[name].append(float(difference.detach()[numbers][judged].square().mean()))
    return out


def degree_needed(errors: list[float], worth: float) -> int:
    """The lowest degree whose error is within ``worth`` (a share) of the best; 0 where nothing could be judged and errors are NaN."""
    return next((degree for degree, error in enumerate(errors) if error <= (1.0 + worth) * min(errors)), 0)


def exposure_spread(residuals: Residuals, frames: int) -> tuple[float, float]:
    """Standard deviation of log exposure between frames beyond what noise gives, and the error of one frame's, medians.

    Each frame's gain is the least-squares factor between predicted and target.
    """
    gains, errors = [], []
    for frame in range(frames):
        here = residuals.frame == frame
        p, t = residuals.predicted[here].astype(np.float64), residuals.target[here].astype(np.float64)
        power = float(p @ p)
        if here.sum() < 16 or power <= 0:
            continue
        gain = float(p @ t) / power
        if gain > 0:
            gains.append(np.log(gain))
            errors.append(np.sqrt(np.square(p * (t - gain * p)).sum()) / (power * gain))
    if len(gains) < 2:
        return 0.0, 0.0
    error = float(np.median(errors))
    # a robust spread: a frame in which something else is wrong is not an exposure
    spread = 1.4826 * float(np.median(np.abs(np.array(gains) - np.median(gains))))
    return float(np.sqrt(max(spread**2 - error**2, 0.0))), error
