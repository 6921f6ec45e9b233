"""Results of fits made by hand: no fit is run."""

from __future__ import annotations

from typing import Any


def scores(**psnr: float) -> dict[str, Any]:
    """As ``evaluate`` gives them: modality → PSNR against raw pixels; 1 dB less against the truth; ``ms`` and ``pol`` with their own."""
    own = {"ms": {"sam": 4.0}, "pol": {"aolp_mae": 20.0, "dolp_rmse": 0.05}}
    modalities = {
        name: {
            "psnr": value,
            "psnr_foreground": value - 2,
            "foreground_from": "gt",
            "ssim": 0.9,
            "psnr_truth": value - 1,
            **own.get(name, {}),
        }
        for name, value in psnr.items()
    }
    return {
        "modalities": modalities,
        "geometry": {"depth_mae": 0.01, "chamfer_visible": 0.002},
        "views": [9],
        "seconds": {"render": 1.0, "total": 2.0},
        "rays_per_s": 1000.0,
    }


def measured(seconds: float = 2.0, **psnr: float) -> dict[str, Any]:
    """As ``worker.work`` gives it."""
    return {
        "seconds": seconds,
        "earlier_seconds": 0.0,
        "cpu_share": 0.9,
        "startup_seconds": 5.0,
        "load_seconds": 1.0,
        "peak_memory_bytes": 500_000_000,
        "steps": 100,
        "rays_per_s": 2000.0,
        "samples_per_s": 30000.0,
        "render_rays_per_s": 1000.0,
        "scores": scores(**(psnr or {"rgb": 30.0, "ms": 28.0})),
    }
