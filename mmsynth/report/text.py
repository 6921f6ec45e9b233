"""Scores as a table of plain text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_COLUMNS = {
    "psnr": "psnr [dB]",
    "psnr_foreground": "foreground",
    "ssim": "ssim",
    "psnr_truth": "truth [dB]",
    "sam": "sam [deg]",
    "dolp_rmse": "dolp rmse",
    "aolp_mae": "aolp [deg]",
}


def score_text(scores: Mapping[str, Any]) -> str:
    """The result of ``evaluate`` as lines: one row per modality, then geometry and speed."""
    modalities: Mapping[str, Mapping[str, Any]] = scores["modalities"]
    keys = [k for k in _COLUMNS if any(k in m for m in modalities.values())]
    lines = ["".join([f"{'modality':10s}"] + [f"{_COLUMNS[k]:>12s}" for k in keys])]
    for name, m in modalities.items():
        lines.append("".join([f"{name:10s}"] + [f"{m[k]:12.3f}" if isinstance(m.get(k), float) else f"{'':12s}" for k in keys]))
    sources = {m["foreground_from"] for m in modalities.values() if "foreground_from" in m}
    if "opacity" in sources:
        lines.append("foreground: the field's own opacity > 0.5, for want of masks; not comparable between fits")
    lines += [f"{key}: {value:.5g}" for key, value in scores.get("geometry", {}).items() if isinstance(value, float)]
    seconds = ", ".join(f"{k} {v:.1f}" for k, v in scores.get("seconds", {}).items() if isinstance(v, (int, float)))
    lines.append(f"seconds: {seconds}; {scores.get('rays_per_s', 0):,.0f} rays/s")
    return "\n".join(lines)
