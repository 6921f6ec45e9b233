"""Which part of the work is this process's, where several run the same command (torchrun sets RANK and WORLD_SIZE): no process waits for
another, none sends anything; whoever finds everything finished writes the summary."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch

from mmsynth.errors import InputError


@dataclass(frozen=True)
class WorkPartition:
    """One of ``processes``, counted from 0."""

    number: int = 0
    processes: int = 1

    def of(self, units: int, together: int = 1) -> range:
        """A stretch of ``units`` things to do, neighbours together, cut only between groups of ``together``."""
        groups = -(-units // together)
        first, last = (groups * k // self.processes * together for k in (self.number, self.number + 1))
        return range(min(first, units), min(last, units))


def partition_of_environment() -> WorkPartition:
    """From RANK and WORLD_SIZE, all of it where they are not set.

    Raises:
        InputError: they are not two whole numbers with 0 <= RANK < WORLD_SIZE.
    """
    rank, size = os.environ.get("RANK", "0"), os.environ.get("WORLD_SIZE", "1")
    if not (rank.isdecimal() and size.isdecimal() and int(rank) < int(size)):
        raise InputError(f"environment: RANK is {rank!r} and WORLD_SIZE {size!r}, expected whole numbers, RANK below WORLD_SIZE.")
    return WorkPartition(int(rank), int(size))


def local_device(device: str) -> str:
    """ "cuda" → the GPU of this process (torchrun's LOCAL_RANK, modulo how many there are); anything else as it is.

    That GPU is the current one from then on: what names no device would take memory of the first GPU from each process.

    Raises:
        InputError: LOCAL_RANK is no whole number.
    """
    if device != "cuda":
        return device
    rank = os.environ.get("LOCAL_RANK", "0")
    if not rank.isdecimal():
        raise InputError(f"environment: LOCAL_RANK is {rank!r}, expected a whole number.")
    index = int(rank) % torch.cuda.device_count()
    torch.cuda.set_device(index)
    return f"cuda:{index}"
