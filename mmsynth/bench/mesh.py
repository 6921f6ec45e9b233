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
from mmsynth.bench.output import Report, new_figure, write_report
from mmsynth.bench.tables import Column, Table, lookup
from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.operations.output.progress import Progress

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
    for done, task in enumerate(tasks, 1):
        found = in_a_process("mmsynth.bench.mesh_worker", task, f"{task['method']} at {task['resolution']}")
        results["rows"].append({**task, **fits[str(task["run"])], **found})
        report = write_report(results, [table_of(results["rows"])], plot(results["rows"]), out)
        if progress is not None:
            progress(done, len(tasks))
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
        Column("faces", "mesh/faces", ",d"),
        Column("pieces", "mesh/components", "d"),
        Column("watertight", "mesh/watertight", "d"),
        Column("Euler", "mesh/euler_number", "d"),
        Column("off zero [cells]", "mesh/residual/rms_cells", ".1e"),
        Column("accuracy", "against/accuracy", ".6f"),
        Column("completeness", "against/completeness", ".6f"),
        Column("Chamfer", "against/chamfer", ".6f"),
        *(Column(f"F at {distance}", f"against/f_score/{distance}", ".3f") for distance in f_scores),
        Column("normals", "against/normal_consistency", ".3f"),
    )
    note = (
        "Every mesh in a process of its own; memory: the most of all of it, the field and Python with it. cpu: processor time by wall time "
        "and threads. Lengths in the scene's unit. Off zero: |f| at the vertices, rms. Accuracy, completeness, F: what training views see."
    )
    return Table("Meshes", columns, rows, note)


def plot(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Seconds, memory and, with a reference, Chamfer over resolution, both log; a line per fit and method."""
    panels = [("seconds", "seconds", 1.0), ("peak_memory_bytes", "peak memory [MB]", 1e-6)]
    if any(lookup(row, "against/chamfer") is not None for row in rows):
        panels.append(("against/chamfer", "Chamfer distance [scene unit]", 1.0))
    figure, axes = new_figure(len(panels))
    lines = dict.fromkeys((row["run"], row["budget"], row["method"]) for row in rows)
    for one, (path, label, scale) in zip(axes, panels, strict=True):
        for run, budget, method in lines:
            here = [row for row in rows if (row["run"], row["method"]) == (run, method) and lookup(row, path) is not None]
            one.plot([r["resolution"] for r in here], [lookup(r, path) * scale for r in here], "o-", label=f"fit of {budget}: {method}")
        one.set(xscale="log", yscale="log", xlabel="cells across the region", ylabel=label)
        one.set_xticks(sorted({row["resolution"] for row in rows}), [str(n) for n in sorted({row["resolution"] for row in rows})])
        one.minorticks_off()
        one.legend(frameon=False, fontsize=7)
    return figure
