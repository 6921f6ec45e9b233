"""``mmsynth bench mesh``: resolution against time, memory and Chamfer distance, beside the usual extraction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from mmsynth.bench.fit import budget_name
from mmsynth.bench.jobs import in_a_process
from mmsynth.bench.machine import measure
from mmsynth.bench.mesh_worker import METHODS
from mmsynth.bench.output import Report, line_panels, write_report
from mmsynth.bench.tables import Column, Table, lookup, numbers
from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.operations.output.progress import Counter, Progress

RESOLUTIONS = (64, 128, 256, 512)


def bench_mesh(
    runs: Sequence[Path],
    out: Path,
    resolutions: Sequence[int] = RESOLUTIONS,
    methods: Sequence[str] | None = None,
    against: Path | None = None,
    distances: Sequence[float] | None = None,
    progress: Progress | None = None,
) -> Report:
    """Mesh every run at every resolution by every method, each in a process of its own.

    Args:
        methods: of ``mesh_worker.METHODS``; None: all. against: the true mesh, in the runs' frame and unit; what the training views see of
            it counts. distances: of its F-score. progress: called with (meshes done, meshes in all).
    Raises:
        InputError: an unknown method, no such run or mesh, or ``out`` cannot be written.
    """
    chosen = list(METHODS) if methods is None else list(methods)
    for method in chosen:
        if method not in METHODS:
            raise InputError(f"bench mesh: no method {method!r}, expected some of {'; '.join(METHODS)}.")
    if not resolutions or min(resolutions) < 2:
        raise InputError("bench mesh: expected one or more resolutions of at least 2 cells.")
    if against is not None and not against.is_file():
        raise InputError(f"{against}: no such file, expected a mesh to compare with.")
    fits = {str(run): _fit(run) for run in runs}
    tasks = [
        {"run": str(run), "resolution": n, "method": method, "against": None if against is None else str(against), "distances": distances}
        for run in runs for n in sorted(resolutions) for method in chosen
    ]  # fmt: skip
    results: dict[str, Any] = {"bench": "mesh", "machine": measure(), "rows": []}
    counter = Counter(progress, len(tasks))
    for task in tasks:
        found = in_a_process("mmsynth.bench.mesh_worker", task, f"{task['method']} at {task['resolution']}")
        results["rows"].append({**task, **fits[str(task["run"])], **found})
        report = write_report(results, [table_of(results["rows"])], plot(results["rows"]), out)
        counter(1)
    return report


def _fit(run: Path) -> dict[str, Any]:
    """``budget`` and ``steps`` of a finished fit."""
    if not (run / "manifest.json").is_file():
        raise InputError(f"{run}: holds no finished fit (no manifest.json); run `mmsynth fit SCENE` first.")
    manifest = read_json(run / "manifest.json")
    return {"budget": budget_name(round(float(manifest["seconds"]["fit"]))), "steps": manifest["steps"]}


def table_of(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Cost beside error, a row per mesh."""
    f_scores = dict.fromkeys(distance for row in rows for distance in lookup(row, "against/f_score") or ())
    columns = (
        Column("fit", "budget"),
        Column("steps", "steps", ",d"),
        Column("cells", "resolution", "d"),
        Column("method", "method"),
        Column("seconds", "seconds", ".1f"),
        Column("cpu", "cpu_share", ".0%"),
        Column("memory [MB]", "peak_memory_bytes", ",.0f", 1e-6),
        *numbers(",d", {"faces": "mesh/faces", "pieces": "mesh/components"}),
        *numbers("d", {"watertight": "mesh/watertight", "Euler": "mesh/euler_number"}),
        Column("off zero [cells]", "mesh/residual/rms_cells", ".1e"),
        *numbers(".6f", {name: f"against/{name.lower()}" for name in ("accuracy", "completeness", "Chamfer")}),
        *numbers(".3f", {f"F at {distance}": f"against/f_score/{distance}" for distance in f_scores}),
        Column("normals", "against/normal_consistency", ".3f"),
    )
    note = (
        "Every mesh in a process of its own; memory: the most of all of it, the field and Python with it. cpu: processor time by wall time "
        "and threads. Lengths in the scene's unit. Off zero: |f| at the vertices, rms. Accuracy, completeness, F: what training views see."
    )
    return Table("Meshes", columns, rows, note)


def plot(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Seconds, memory and, with a reference, Chamfer over resolution, both log; a line per fit and method."""
    panels: dict[str, dict[str, dict[float, float | None]]] = {}
    for row in rows:
        memory, chamfer = row["peak_memory_bytes"] * 1e-6, lookup(row, "against/chamfer")
        for label, y in (("seconds", row["seconds"]), ("peak memory [MB]", memory), ("Chamfer distance [scene unit]", chamfer)):
            lines = panels.setdefault(label, {})
            lines.setdefault(f"{row['run']}, fit of {row['budget']}: {row['method']}", {})[row["resolution"]] = y
    ticks = {n: str(n) for n in sorted({row["resolution"] for row in rows})}
    return line_panels(panels, "cells across the region", ticks, yscale="log")
