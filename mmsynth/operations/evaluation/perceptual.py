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


def lpips_package() -> str | None:
    """``lpips`` or ``torchmetrics``, the one that can be used here; None: neither, or torchvision or its weights are not there."""
    if find_spec("torchvision") is None or not any((Path(torch.hub.get_dir()) / "checkpoints").glob("alexnet-*.pth")):
        return None
    return next((name for name in ("lpips", "torchmetrics") if find_spec(name) is not None), None)


@functools.lru_cache(maxsize=1)
def find_lpips() -> Distance | None:
    """The distance, None where ``lpips_package`` is."""
    package = lpips_package()
    if package is None:
        return None
    score: Any
    if package == "lpips":
        import lpips

        score = lpips.LPIPS(net="alex", verbose=False).eval()
    else:
        from torchmetrics.functional.image import learned_perceptual_image_patch_similarity

        score = functools.partial(learned_perceptual_image_patch_similarity, net_type="alex")

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
