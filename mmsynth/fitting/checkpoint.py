"""Checkpoints: all that an interrupted fit needs to continue to the same result, in one file, replaced atomically."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from mmsynth.errors import InputError, is_out_of_memory
from mmsynth.files import write_atomic

CHECKPOINT_FOLDER = "checkpoint"  # of a run
_NAME = "state.pt"


def write_checkpoint(run: Path, state: dict[str, Any]) -> None:
    """Replace the run's checkpoint. ``state`` holds tensors, numbers, strings and containers of them."""
    write_atomic(run / CHECKPOINT_FOLDER / _NAME, lambda path: _save(state, path))


def _save(state: dict[str, Any], path: Path) -> None:
    try:
        with open(path, "wb") as stream:  # not as bytes first: they would be kept twice
            torch.save(state, stream)
    except RuntimeError as error:  # of torch's own, where the stream cannot be written
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


def read_checkpoint(run: Path) -> dict[str, Any] | None:
    """The run's checkpoint, or None when it has none.

    Raises:
        InputError: the file is broken.
    """
    path = run / CHECKPOINT_FOLDER / _NAME
    if not path.is_file():
        return None
    try:
        return torch.load(path, map_location="cpu", weights_only=True)  # the device that it was made on may not be here
    except Exception as error:  # torch raises many kinds for a broken archive
        if is_out_of_memory(error):
            raise
        raise InputError(f"{path}: not a readable checkpoint ({str(error).splitlines()[0]}).") from error
