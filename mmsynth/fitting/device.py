"""The device that a fit or a rendering runs on."""

from __future__ import annotations

import torch

from mmsynth.errors import InputError


def pick_device(name: str) -> str:
    """``auto`` → cuda where there is one, else cpu.

    Raises:
        InputError: the device is unknown or not there.
    """
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name not in ("cpu", "cuda"):
        raise InputError(f"--device {name!r}: expected auto, cpu or cuda.")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: torch finds no CUDA device here; use cpu.")
    return name
