"""Samples of made-up scenes: paints of smooth spectra under black bodies, seen by sensors of Gaussian responses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from mmsynth.prior.samples import SceneSamples, Shapes
from mmsynth.scene.exposure import Exposure
from mmsynth.scene.scene import Sensor

NM = np.arange(400.0, 1001.0, 5.0)
RGB = Sensor("rgb", ("R", "G", "B"), (None, None, None))
NIR = Sensor("nir", ("nir",), (None,))
MS = Sensor("ms", ("450nm", "550nm", "650nm", "700nm"), (450.0, 550.0, 650.0, 700.0))
POL = Sensor("pol", ("I0", "I45", "I90", "I135"), (None,) * 4, polarizer_angles_deg=(0.0, 45.0, 90.0, 135.0))
SENSORS = {s.name: s for s in (RGB, NIR, MS, POL)}
_PEAKS = {"rgb": (610.0, 540.0, 460.0), "nir": (860.0,), "ms": (450.0, 550.0, 650.0, 700.0), "pol": (550.0,)}
_WIDTHS = {"rgb": 35.0, "nir": 50.0, "ms": 15.0, "pol": 60.0}
RESPONSES = {n: np.stack([np.exp(-0.5 * ((NM - p) / _WIDTHS[n]) ** 2) for p in peaks]) for n, peaks in _PEAKS.items()}


def black_body(kelvin: float) -> NDArray[np.float64]:
    """Planck's law at NM, 1 at 560 nm."""
    radiance = lambda nm: 1.0 / (nm**5 * np.expm1(1.4387769e7 / (nm * kelvin)))
    return np.asarray(radiance(NM) / radiance(560.0))


def paints(count: int, seed: int, *, smooth: float = 120.0) -> NDArray[np.float64]:
    """Reflectances (count, NM) in (0, 1): a random mean and smooth random deviations from it."""
    random = np.random.default_rng(seed)
    apart = (NM[:, None] - NM) / smooth
    root = np.linalg.cholesky(np.exp(-0.5 * apart**2) + 1e-8 * np.eye(len(NM)))
    return np.asarray(
        1.0 / (1.0 + np.exp(-(random.normal(-0.5, 0.8, (count, 1)) + 1.2 * random.standard_normal((count, len(NM))) @ root.T)))
    )


def light_of(
    reflectance: NDArray[np.float64], shade: NDArray[np.float64], kelvin: float, gains: dict[str, float], names: Sequence[str]
) -> dict[str, NDArray[np.float64]]:
    """What sensors show of paints (P, NM) in each of N places (their index, shade): per modality (N, C)."""
    lamp = black_body(kelvin)
    return {n: gains[n] * shade[:, None] * (reflectance * lamp @ RESPONSES[n].T) for n in names}


def white(kelvin: float, gains: dict[str, float], names: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """What a white board shows in each channel."""
    return {n: gains[n] * (RESPONSES[n] @ black_body(kelvin)) for n in names}


def room(
    seed: int,
    kelvin: float,
    *,
    names: Sequence[str] = ("rgb", "nir", "ms"),
    gains: dict[str, float] | None = None,
    lamp: bool = True,
    stated: bool = True,
    count: int = 40,
    rays: int = 3000,
    reflectance: NDArray[np.float64] | None = None,
) -> SceneSamples:
    """A scene of random paints. lamp: surfaces mirror it, so its spectrum is known. stated: its gains are."""
    random = np.random.default_rng(seed + 1000)
    gains = gains or {n: float(np.exp(random.normal(-3.0, 0.5))) for n in SENSORS}
    pigments = paints(count, seed) if reflectance is None else reflectance
    which = random.integers(0, len(pigments), rays)
    body = light_of(pigments[which], random.uniform(0.2, 1.0, rays), kelvin, gains, names)
    cosine = torch.from_numpy(random.uniform(0.1, 1.0, rays)).float()
    angle = torch.from_numpy(random.uniform(0, np.pi, rays)).float()
    shapes = Shapes(cosine, torch.stack([torch.cos(2 * angle), torch.sin(2 * angle)], -1), torch.full((rays,), 0.2), torch.zeros(rays))
    polarized = None
    if "pol" in names:
        q = -0.4 * (1.0 - shapes.cosine) ** 2  # made up: across the plane, and more so the more it grazes
        polarized = (q[:, None] * shapes.turn * torch.from_numpy(body["pol"]).float()).double().numpy()
    return SceneSamples(
        f"room{seed}",
        {n: SENSORS[n] for n in names},
        Exposure({n: gains[n] for n in names}) if stated else Exposure(),
        body,
        white(kelvin, gains, names) if lamp else None,
        np.zeros((rays, 3)),
        polarized,
        shapes,
    )
