"""What a few frames of a modality add to its prediction.

The prediction is the mean, and what frames add to it is a Gaussian process over the places of a scene (Rasmussen and Williams 2006, §2.2
and, for the inducing points, §8.3.2): y - k p = s f(z) + noise. p is the prediction, k one gain, s the mean reflected light of the surface
times white, so that f is free of exposure. A place z is colour, brightness and position: two surfaces of one colour are likely one paint,
and more likely so where they lie side by side; far from all frames f is 0, and the prediction stays. How large f may be is what the prior
says of how much spectra differ: much for near infrared behind RGB, little for a panchromatic sensor. How alike colours and how near
positions have to be, and how much of what is missed is noise, is what the frames make likeliest (§5.4.1). Of polarization S0 and q are
corrected together: I = (S0 + S0 q cos 2(θ - a)) / 2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

LENGTHS = tuple((colour, position) for colour in (0.15, 0.3, 0.6) for position in (0.15, 0.3))
"""To choose from: in chromaticity over the mean channel, of paints of one scene, and in position over the region's radius."""
_BESIDE = 2.0  # times that for surfaces that lie side by side
_BRIGHTNESS = 1.0  # length in log brightness
_POINTS = 300  # at which f is known
_ROWS = 24_576  # that are learned from
_CHOSEN_BY = 4096  # of these, that lengths are chosen by
_ALIKE = 8.0  # pixels beside each other whose errors are one
_NOISE = (1.0, 0.5, 0.25, 0.1)  # to choose from, of the mean square of what the prediction misses
_JITTER = 1e-5
_DARK = 0.02  # of the scene's mean
_GAIN_DEVIATION = 0.05  # at the least
_ALL_ALIKE = 64.0  # pixels whose errors in level are one

_TENSORS = ("points", "weights", "unknown")

Rows = tuple[Tensor, Tensor, Tensor, Tensor]
"""N numbers that P functions f are learned from: ``places`` (N, Z), ``parts`` (N, P) what each f is multiplied with in a number, ``sizes``
(P,) deviation of each f before, ``rest`` (N,) what the prediction misses."""


def places_of(reflected: Tensor, position: Tensor, level: float) -> Tensor:
    """Reflected light (R, A) and position (R, 3), normalised frame → (R, A + 4).

    Args:
        level: mean reflected light of the scene.
    """
    mean = reflected.mean(1, keepdim=True)
    chroma = reflected / (mean + _DARK * level) * (3.0 / reflected.shape[1]) ** 0.5
    radius = torch.linalg.vector_norm(position, dim=1, keepdim=True).clamp(min=1.0)
    return torch.cat([chroma, torch.log(mean / level + _DARK), position / radius * (2.0 - 1.0 / radius)], 1)


def covariance(a: Tensor, b: Tensor, lengths: tuple[float, float]) -> Tensor:
    """Of f at places (A, Z) and (B, Z), in units of its variance: (A, B), 1 on the diagonal. ``lengths``: one of ``LENGTHS``."""
    colour_length, position_length = lengths
    apart = lambda part: torch.cdist(a[:, part], b[:, part], compute_mode="donot_use_mm_for_euclid_dist").square()
    colour = apart(slice(0, -4)) / colour_length**2 + apart(slice(-4, -3)) / _BRIGHTNESS**2
    beside = colour / _BESIDE**2 + apart(slice(-3, None)) / position_length**2
    return 0.5 * (torch.exp(-0.5 * colour) + torch.exp(-0.5 * beside))


@dataclass(frozen=True)
class Correction:
    """Of one modality in C numbers: its channels, of polarization S0 and q.

    Attributes:
        gain: k. points: (M, Z) places. weights: (C, M), f(z) = weights · covariance(points, z). unknown: (C, M, M), such that the
            variance of f is 1 - k · unknown k of that before frames were seen, with k = covariance(points, z). lengths: of covariance.
        frames: how many taught it. before, after: rms of the rows' error, predicted and corrected; 1.0 = full scale.
    """

    gain: float
    points: Tensor
    weights: Tensor
    unknown: Tensor
    lengths: tuple[float, float]
    frames: int
    before: float
    after: float

    def about(self) -> dict[str, Any]:
        """All but the tensors, ready for JSON."""
        return {"gain": self.gain, "lengths": list(self.lengths), "frames": self.frames, "before": self.before, "after": self.after}

    def tensors(self) -> dict[str, Tensor]:
        """The tensors, by name."""
        return {key: getattr(self, key).contiguous() for key in _TENSORS}

    @classmethod
    def from_parts(cls, about: Mapping[str, Any], name: str, tensors: Mapping[str, Tensor]) -> Correction:
        """What ``about`` and, by keys that begin with the modality's name, ``tensors`` gave."""
        parts: dict[str, Any] = {**about, "lengths": tuple(about["lengths"]), **{key: tensors[f"{name}.{key}"] for key in _TENSORS}}
        return cls(**parts)

    def __call__(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """f and its standard deviation, over that before frames were seen, (R, C) each."""
        k = covariance(places, self.points, self.lengths)
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


def choose_lengths(points: Tensor, of_channels: Sequence[Rows]) -> tuple[float, float]:
    """The lengths under which the rows of all channels are likeliest; ``points``: (M, Z)."""
    few = [_some((places, parts, sizes, rest), _CHOSEN_BY // len(of_channels)) for places, parts, sizes, rest in of_channels]
    return max(LENGTHS, key=lambda lengths: sum(_likeliest_noise(_features(points, rows, lengths)[0], rows[3])[1] for rows in few))


def learn(points: Tensor, rows: Rows, lengths: tuple[float, float]) -> tuple[Tensor, Tensor, Tensor]:
    """Learn P functions f.

    Args:
        points: (M, Z).
    Returns:
        ``weights`` (P, M) and ``unknown`` (P, M, M) of ``Correction``, and what is still missed, (N,).
    """
    places, parts, sizes, rest = rows
    some, count, double = _some(rows, _ROWS), len(points), torch.float64
    features, inverse = _features(points, some, lengths)
    wanted = some[3].double()
    noise = _ALIKE * _likeliest_noise(features, some[3])[0]
    precision = features.T @ features / noise + torch.eye(features.shape[1], dtype=double)
    solution = torch.linalg.solve(precision, features.T @ wanted / noise).view(-1, count)
    posterior = torch.linalg.inv(precision)
    blocks = [posterior[i * count : (i + 1) * count, i * count : (i + 1) * count] for i in range(len(sizes))]
    known = torch.stack([inverse.T @ (torch.eye(count, dtype=double) - block) @ inverse for block in blocks])
    weights = sizes.double()[:, None] * solution @ inverse
    f = covariance(places, points, lengths) @ weights.float().T
    return weights.float(), known.float(), rest - (parts * f).sum(1)


def _some(rows: Rows, count: int) -> Rows:
    """A random few."""
    places, parts, sizes, rest = rows
    chosen = torch.randperm(len(places), generator=torch.Generator().manual_seed(1))[:count]
    return places[chosen], parts[chosen], sizes, rest[chosen]


def _features(points: Tensor, rows: Rows, lengths: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """(N, P · M), in which the numbers are linear, with coefficients that are normal before frames are seen; and (M, M), the inverse root
    of the points' covariance."""
    places, parts, sizes, _ = rows
    double = torch.float64
    own = covariance(points.double(), points.double(), lengths) + _JITTER * torch.eye(len(points), dtype=double)
    inverse = torch.linalg.inv(torch.linalg.cholesky(own))
    of_places = covariance(places.double(), points.double(), lengths) @ inverse.T
    return torch.cat([size * part[:, None] * of_places for size, part in zip(sizes.double(), parts.double().T, strict=True)], 1), inverse


def _likeliest_noise(features: Tensor, rest: Tensor) -> tuple[float, float]:
    """Variance of the noise, by ``_NOISE``, and the log of the marginal likelihood under it up to a constant, as if one in ``_ALIKE`` rows
    were independent."""
    wanted = rest.double()
    values, vectors = torch.linalg.eigh(features.T @ features)
    values = values.clamp(min=0.0)
    along = (vectors.T @ (features.T @ wanted)).square()
    square = max(float(wanted.square().mean()), 1e-12)

    def likelihood(variance: float) -> float:
        noise = _ALIKE * variance
        fitted = wanted.square().sum() / noise - (along / noise**2 / (1.0 + values / noise)).sum()
        return -0.5 * float(fitted + torch.log1p(values / noise).sum()) - 0.5 * len(wanted) / _ALIKE * math.log(variance)

    return max(((share * square, likelihood(share * square)) for share in _NOISE), key=lambda found: found[1])
