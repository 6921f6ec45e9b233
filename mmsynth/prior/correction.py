"""What a few frames of a modality add to its prediction.

The prediction is the mean, and what frames add to it is a Gaussian process over the places of a scene (Rasmussen and Williams 2006, §2.2
and, for
the inducing points, §8.3.2): y - k p = s f(z) + noise. p is the prediction, k one gain, s the mean reflected light of the surface times
white, so
that f is free of exposure. A place z is colour, brightness and position: two surfaces of one colour are likely one paint, and more likely
so where they lie side by side; far from all frames f is 0, and the prediction stays. How large f may be is what the prior says of how much
spectra differ: much for near infrared behind RGB, little for a panchromatic sensor. Of polarization S0 and q are corrected together:
I = (S0 + S0 q cos 2(θ - a)) / 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

_COLOUR = 0.3  # length in chromaticity over the mean channel, of paints of one scene
_BESIDE = 2.0  # times that for surfaces that lie side by side
_BRIGHTNESS = 1.0  # length in log brightness
_POSITION = 0.3  # length, of the region's radius
_POINTS = 300  # at which f is known
_ROWS = 24_576  # that are learned from
_ALIKE = 8.0  # pixels beside each other whose errors are one
_JITTER = 1e-5
_DARK = 0.02  # of the scene's mean
_GAIN_DEVIATION = 0.05  # at the least
_ALL_ALIKE = 64.0  # pixels whose errors in level are one

_TENSORS = ("points", "weights", "unknown")


def places_of(reflected: Tensor, position: Tensor, level: float) -> Tensor:
    """Reflected light (R, A) and position (R, 3), normalised frame → (R, A + 4).

    Args:
        level: mean reflected light of the scene.
    """
    mean = reflected.mean(1, keepdim=True)
    chroma = reflected / (mean + _DARK * level) * (3.0 / reflected.shape[1]) ** 0.5
    radius = torch.linalg.vector_norm(position, dim=1, keepdim=True).clamp(min=1.0)
    return torch.cat([chroma, torch.log(mean / level + _DARK), position / radius * (2.0 - 1.0 / radius)], 1)


def covariance(a: Tensor, b: Tensor) -> Tensor:
    """Of f at places (A, Z) and (B, Z), in units of its variance: (A, B), 1 on the diagonal."""
    apart = lambda part: torch.cdist(a[:, part], b[:, part], compute_mode="donot_use_mm_for_euclid_dist").square()
    colour = apart(slice(0, -4)) / _COLOUR**2 + apart(slice(-4, -3)) / _BRIGHTNESS**2
    beside = colour / _BESIDE**2 + apart(slice(-3, None)) / _POSITION**2
    return 0.5 * (torch.exp(-0.5 * colour) + torch.exp(-0.5 * beside))


@dataclass(frozen=True)
class Correction:
    """Of one modality in C numbers: its channels, of polarization S0 and q.

    Attributes:
        gain: k. points: (M, Z) places. weights: (C, M), f(z) = weights · covariance(points, z). unknown: (C, M, M), such that the
            variance of f
            is 1 - k · unknown k of that before frames were seen, with k = covariance(points, z).
        frames: how many taught it. before, after: rms of the rows' error, predicted and corrected; 1.0 = full scale.
    """

    gain: float
    points: Tensor
    weights: Tensor
    unknown: Tensor
    frames: int
    before: float
    after: float

    def about(self) -> dict[str, float | int]:
        """All but the tensors, ready for JSON."""
        return {"gain": self.gain, "frames": self.frames, "before": self.before, "after": self.after}

    def tensors(self) -> dict[str, Tensor]:
        """The tensors, by name."""
        return {key: getattr(self, key).contiguous() for key in _TENSORS}

    @classmethod
    def from_parts(cls, about: Mapping[str, Any], name: str, tensors: Mapping[str, Tensor]) -> Correction:
        """What ``about`` and, by keys that begin with the modality's name, ``tensors`` gave."""
        parts: dict[str, Any] = {**about, **{key: tensors[f"{name}.{key}"] for key in _TENSORS}}
        return cls(**parts)

    def __call__(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """f and its standard deviation, over that before frames were seen, (R, C) each."""
        k = covariance(places, self.points)
        known = torch.einsum("rm,cmn,rn->rc", k, self.unknown, k)
        return k @ self.weights.T, torch.sqrt((1.0 - known).clamp(0.0, 1.0))


def gain_of(predicted: Tensor, measured: Tensor, deviation: float) -> float:
    """The one gain of a prediction (N,), known beforehand to 1 ± ``deviation``, that suits what was measured (N,)."""
    trust = _ALL_ALIKE * (measured - predicted).double().square().mean() / max(deviation, _GAIN_DEVIATION) ** 2
    ours, both = predicted.double().square().sum(), (predicted.double() * measured.double()).sum()
    return float((both + trust) / (ours + trust).clamp(min=1e-30))


def choose_points(places: Tensor) -> Tensor:
    """Places (M, Z) of a random few of the rows (N, Z), at which f will be known."""
    return places[torch.randperm(len(places), generator=torch.Generator().manual_seed(0))[:_POINTS]]


def learn(points: Tensor, places: Tensor, parts: Tensor, sizes: Tensor, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Learn P functions f from N numbers.

    Args:
        points: (M, Z). places: (N, Z). parts: (N, P) what each f is multiplied with in a number. sizes: (P,) deviation of each f before.
        rest: (N,) what the prediction misses.
    Returns:
        ``weights`` (P, M) and ``unknown`` (P, M, M) of ``Correction``, and what is still missed, (N,).
    """
    chosen = torch.randperm(len(places), generator=torch.Generator().manual_seed(1))[:_ROWS]
    count, double = len(points), torch.float64
    own = covariance(points.double(), points.double()) + _JITTER * torch.eye(count, dtype=double)
    root = torch.linalg.cholesky(own)
    inverse = torch.linalg.inv(root)
    features = covariance(places[chosen].double(), points.double()) @ inverse.T
    rows = torch.cat([size * part[:, None] * features for size, part in zip(sizes.double(), parts[chosen].double().T, strict=True)], 1)
    wanted = rest[chosen].double()
    noise = _ALIKE * wanted.square().mean().clamp(min=1e-12)
    precision = rows.T @ rows / noise + torch.eye(rows.shape[1], dtype=double)
    solution = torch.linalg.solve(precision, rows.T @ wanted / noise).view(-1, count)
    posterior = torch.linalg.inv(precision)
    blocks = [posterior[i * count : (i + 1) * count, i * count : (i + 1) * count] for i in range(len(sizes))]
    known = torch.stack([inverse.T @ (torch.eye(count, dtype=double) - block) @ inverse for block in blocks])
    weights = sizes.double()[:, None] * solution @ inverse
    f = covariance(places, points) @ weights.float().T
    return weights.float(), known.float(), rest - (parts * f).sum(1)
