"""Ways to compute something, timed beside each other: speed against error.

Speeds are medians of repeats in which the methods of one problem take turns, per element; on one thread unless a bench says otherwise.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from mmsynth.bench.machine import use_threads
from mmsynth.bench.tables import Column, Table, numbers
from mmsynth.errors import InputError
from mmsynth.operations.output.progress import Counter, Progress

REPEATS = 7
COLUMNS = (
    *numbers("", {"problem": "problem", "method": "method"}),
    Column("ns", "ns", ".1f"),
    *numbers(".5g", {"found": "found", "closed form": "truth"}),
    Column("deviations", "deviations", ".1f"),
    *numbers(".1e", {"error": "error", "worst": "worst", "expected error": "expected_error"}),
    Column("noise gain", "noise_gain", ".2f"),
    *numbers(".1%", {"gain": "gain", "read": "read", "read, at best": "read_at_best", "PRNU": "prnu"}),
    Column("in", "unit"),
    *numbers(".2%", {"wrong": "wrong", "masked": "missing"}),
    Column("PSNR [dB]", "psnr", ".2f"),
)
Family = Callable[..., list[Any]]
"""A function whose name and docstring are those of a table, and which makes its methods."""


@dataclass(frozen=True)
class Method:
    """One way to compute something.

    Attributes:
        problem: what on. name: how. run: the computation. judge: its result → ``error`` (typical), ``worst`` and what else the table has.
        count: elements of a run; times are per element.
    """

    problem: str
    name: str
    run: Callable[[], Any]
    judge: Callable[[Any], dict[str, float]]
    count: int
    unit: str


def chosen_families(families: Sequence[Family], bench: str, only: Sequence[str] | None) -> dict[str, Family]:
    """By name: all, or those named in ``only``.

    Raises:
        InputError: an unknown name.
    """
    known = {family.__name__: family for family in families}
    for name in only or ():
        if name not in known:
            raise InputError(f"bench {bench}: no family {name!r}, expected some of {', '.join(known)}.")
    return {name: family for name, family in known.items() if only is None or name in only}


def measured(families: Mapping[str, Sequence[Method]], repeats: int, progress: Progress | None, threads: int = 1) -> list[dict[str, Any]]:
    """One row per method.

    Args:
        families: their methods, by name. repeats: how often each is timed, after a run that is judged; 0: that run is timed, with all
            that a first one has to do.
    """
    problems = list(dict.fromkeys((family, method.problem) for family, methods in families.items() for method in methods))
    counter = Counter(progress, len(problems))
    rows, before = [], cv2.getNumThreads()
    try:
        cv2.setNumThreads(threads)
        with use_threads(threads):
            for family, problem in problems:
                found = _measured([method for method in families[family] if method.problem == problem], repeats)
                rows += [{"family": family, **row} for row in found]
                counter(1)
    finally:
        cv2.setNumThreads(before)
    return rows


def _measured(group: Sequence[Method], repeats: int) -> list[dict[str, Any]]:
    """``cpu_ns``: as ``ns``, of CPU time: on a machine that others use, too, it says more than time."""

    def timed(method: Method) -> tuple[Any, tuple[float, float]]:
        began, busy = time.perf_counter(), time.process_time()
        result = method.run()
        return result, (time.perf_counter() - began, time.process_time() - busy)

    judged, first = [], []
    for method in group:
        result, taken = timed(method)
        judged.append(method.judge(result))
        first.append(taken)
    turns = [[timed(method)[1] for method in group] for _ in range(repeats)] or [first]
    return [
        {
            "problem": method.problem, "method": method.name, "unit": method.unit,
            "ns": statistics.median(turn[i][0] for turn in turns) / method.count * 1e9,
            "cpu_ns": statistics.median(turn[i][1] for turn in turns) / method.count * 1e9, **found,
        }
        for i, (method, found) in enumerate(zip(group, judged, strict=True))
    ]  # fmt: skip


def typical(error: np.ndarray) -> dict[str, float]:
    """``error``: root mean square, and ``worst``."""
    error = np.asarray(error, dtype=np.float64)
    return {"error": float(np.sqrt(np.mean(error**2))), "worst": float(error.max())} if error.size else {}


def family_tables(
    rows: Sequence[Mapping[str, Any]], families: Sequence[Family], columns: Sequence[Column] = COLUMNS, note: str = ""
) -> list[Table]:
    """A table per family that has rows; its note is the first paragraph of its function's docstring, and ``note``."""
    notes = {f.__name__.replace("_", " "): " ".join((f.__doc__ or "").split("\n\n")[0].split()) + note for f in families}
    here = dict.fromkeys(row["family"] for row in rows)
    return [Table(name.capitalize(), columns, [row for row in rows if row["family"] == name], notes[name]) for name in here]
