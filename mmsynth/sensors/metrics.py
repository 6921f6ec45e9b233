"""How far a picture is from another: PSNR, structural similarity, spectral angle. NumPy arrays, peak 1.0 = full scale."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def psnr_from_mse(mse: float) -> float:
    """dB for peak 1.0; an exact match counts as 1e-12 (120 dB), because JSON has no infinity (kornia's and torchmetrics' are infinite)."""
    return -10.0 * math.log10(max(mse, 1e-12))


def ssim(a: np.ndarray, b: np.ndarray, valid: np.ndarray) -> float | None:
    """Structural similarity (Wang et al. 2004) of single-channel images in [0, 1], mean over valid pixels away from the border.

    Gaussian window of 11 pixels (sigma 1.5); images smaller than that get the largest odd uniform window, below 3 pixels: None.
    Scikit-image's map in float64: kornia's is equal to 3e-13 and takes twice as long, torchmetrics' has no mask.

    Args:
        a, b: (H, W). valid: (H, W) bool; b takes a's values elsewhere, so that no window sees a hole.
    """
    from skimage.metrics import structural_similarity

    window = min(11, *a.shape)
    window -= 1 - window % 2
    if window < 3:
        return None
    b = np.where(valid, b, a)
    options: dict[str, Any] = {"win_size": window}
    if window == 11:
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    similarity = structural_similarity(a.astype(np.float64), b.astype(np.float64), data_range=1.0, full=True, **options)[1]
    pad = window // 2
    inner = (slice(pad, a.shape[0] - pad), slice(pad, a.shape[1] - pad))
    chosen = similarity[inner][valid[inner]]
    return float(chosen.mean()) if chosen.size else None


def ssim_of_channels(a: np.ndarray, b: np.ndarray, valid: np.ndarray) -> list[float]:
    """``ssim`` of each channel of (H, W, C) images that has one."""
    found = (ssim(a[..., c], b[..., c], valid) for c in range(a.shape[-1]))
    return [value for value in found if value is not None]


def spectral_angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between spectra (..., C) in degrees, (...,); NaN where one is black.

    2 atan2(|â - b̂|, |â + b̂|): exact for small angles, where arccos of a float32 dot product (torchmetrics') has lost everything.
    """
    a, b = a.astype(np.float64), b.astype(np.float64)
    lengths = [np.linalg.norm(x, axis=-1, keepdims=True) for x in (a, b)]
    with np.errstate(invalid="ignore", divide="ignore"):
        a, b = (np.where(n > 0, x / n, np.nan) for x, n in zip((a, b), lengths, strict=True))
    return np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))
