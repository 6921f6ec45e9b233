"""LPIPS (Zhang et al. 2018) on AlexNet, where ``lpips`` or torchmetrics and the network's weights are installed. Nothing is downloaded."""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

Distance = Callable[[Tensor, Tensor], float]
"""Of two pictures (3, H, W) in [0, 1]."""
LARGE_ENOUGH = 64
"""Pixels a side below which a picture has no LPIPS: AlexNet's strides leave nothing of it."""


@functools.lru_cache(maxsize=1)
def find_lpips() -> Distance | None:
    """The distance; None where neither package, or not torchvision, or not AlexNet's weights are installed."""
    # torchvision downloads what is not in its cache
    cached = (Path(torch.hub.get_dir()) / "checkpoints").glob("alexnet-*.pth")
    package = next((name for name in ("lpips", "torchmetrics") if find_spec(name) is not None), None)
    if package is None or find_spec("torchvision") is None or not any(cached):
        return None
    score: Any
    try:
        if package == "lpips":
            import lpips

            score = lpips.LPIPS(net="alex", verbose=False).eval()
        else:
            from torchmetrics.functional.image import learned_perceptual_image_patch_similarity

            score = functools.partial(learned_perceptual_image_patch_similarity, net_type="alex")
        score(*torch.zeros(2, 1, 3, LARGE_ENOUGH, LARGE_ENOUGH), normalize=True)
    except Exception:  # a torchvision that was built for another torch says RuntimeError, or AttributeError, or OSError
        return None

    def distance(a: Tensor, b: Tensor) -> float:
        with torch.no_grad():
            return float(score(a[None], b[None], normalize=True))

    return distance


def lpips_of_channels(distance: Distance, a: np.ndarray, b: np.ndarray) -> list[float]:
    """Of pictures (H, W, C) in [0, 1]: three channels as a colour picture, any other number each as a grey one."""
    pictures = [torch.from_numpy(np.ascontiguousarray(np.clip(image, 0.0, 1.0), np.float32)).movedim(-1, 0) for image in (a, b)]
    if len(pictures[0]) == 3:
        return [distance(*pictures)]
    return [distance(one.expand(3, -1, -1), two.expand(3, -1, -1)) for one, two in zip(*pictures, strict=True)]
