"""Named means over the pixels of all views."""

from __future__ import annotations

import numpy as np

from mmsynth.sensors.metrics import psnr_from_mse


class _Mean:
    """Running weighted mean; None when nothing was added."""

    def __init__(self) -> None:
        self.total = self.weight = 0.0

    def add(self, values: np.ndarray, weights: np.ndarray | None = None) -> None:
        good = np.isfinite(values) if weights is None else np.isfinite(values) & np.isfinite(weights)
        known = values[good]
        self.total += float((known if weights is None else known * weights[good].astype(np.float64)).sum(dtype=np.float64))
        self.weight += float(good.sum() if weights is None else weights[good].sum(dtype=np.float64))

    @property
    def value(self) -> float | None:
        return self.total / self.weight if self.weight > 0 else None


class Scores:
    """Named means of one modality; which of them become dB or a root is decided once, at the end."""

    def __init__(self) -> None:
        self.means: dict[str, _Mean] = {}

    def add(self, key: str, values: np.ndarray, weights: np.ndarray | None = None) -> None:
        self.means.setdefault(key, _Mean()).add(values, weights)

    def value(self, key: str) -> float | None:
        mean = self.means[key].value if key in self.means else None
        if mean is None:
            return None
        if key.startswith("psnr"):
            return psnr_from_mse(mean)
        return float(np.sqrt(mean)) if key.endswith("_rmse") else mean
