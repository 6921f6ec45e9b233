"""``mmsynth bench fit``: error over time, one fit from scratch per time budget (the schedules of a fit depend on its length)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from mmsynth.bench.jobs import Job, run_jobs
from mmsynth.bench.machine import measure
from mmsynth.bench.output import Report, line_panels, write_report
from mmsynth.bench.tables import Column, Table, lookup, numbers
from mmsynth.errors import InputError
from mmsynth.fitting.recipe import Recipe
from mmsynth.operations.output.progress import Progress

PSNR_COLUMNS = numbers(
    ".2f",
    {"raw [dB]": "psnr", "truth [dB]": "psnr_truth", "truth full": "psnr_truth_full", "foreground": "psnr_foreground"},
)
LIGHT_COLUMNS = (*numbers(".2f", {"SAM [°]": "sam", "AoLP [°]": "aolp_mae"}), Column("DoLP", "dolp_rmse", ".4f"))
SCORE_COLUMNS = (
    *(replace(column, path=f"mean/{column.path}") for column in (*PSNR_COLUMNS, *LIGHT_COLUMNS)),
    Column("depth", "scores/geometry/depth_mae", ".4g"),
    Column("normals [°]", "scores/geometry/normal_mae_deg", ".2f"),
    Column("Chamfer", "scores/geometry/chamfer_visible", ".4g"),
)
SPEED_COLUMNS = (
    *numbers(",.0f", {"samples/s": "samples_per_s", "rays/s": "rays_per_s", "rendered rays/s": "render_rays_per_s"}),
    Column("peak memory [MB]", "peak_memory_bytes", ",.0f", 1e-6),
    Column("cpu share", "cpu_share", ".0%"),
    *numbers("d", {"cores": "cores", "threads": "threads", "seed": "seed"}),
    Column("device", "device"),
)
MEANING = (
    "PSNR: means over the modalities, on the test views; raw: against the recorded pixels, truth: against noise-free light in the region "
    "of interest. SAM, AoLP, DoLP: of the modalities that have them. Depth and Chamfer in the scene's unit."
)


def bench_fit(
    scene: Path | str,
    budgets: Sequence[float],
    out: Path,
    recipe: Recipe,
    modalities: Sequence[str] | None = None,
    frames: Mapping[str, int] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    device: str = "cpu",
) -> Report:
    """Fit a scene from scratch once per budget and score each; the report in ``out`` is renewed after every fit.

    Budgets whose result already lies in ``out`` are not fitted again (``jobs``).

    Args:
        budgets: training times, seconds. frames: modality → training frames to keep. progress: called with (fits done, fits in all).
    Raises:
        InputError: bad scene, modality or number of frames; a budget twice; a fit that fails; ``out`` cannot be written.
    """
    budgets = sorted(budgets)
    names = [budget_name(budget) for budget in budgets]
    if not names or len(set(names)) < len(names):
        raise InputError(f"budgets {', '.join(names) or 'none'}: expected one or more, each once.")
    chosen = None if modalities is None else tuple(modalities)
    jobs = [
        Job(name, str(scene), recipe, chosen, dict(frames or {}), seed, None, budget, device)
        for name, budget in zip(names, budgets, strict=True)
    ]
    results: dict[str, Any] = {"bench": "fit", "scene": str(scene), "machine": measure(), "rows": []}
    for row in run_jobs(jobs, out, progress):
        results["rows"].append(row)
        report = write_report(results, tables_of(results["rows"]), plot(results["rows"]), out)
    return report


def budget_name(seconds: float) -> str:
    """``30s``, ``2m``, ``1h``: the shortest exact form."""
    for unit, length in (("h", 3600), ("m", 60)):
        if seconds >= length and seconds % length == 0:
            return f"{seconds / length:g}{unit}"
    return f"{seconds:g}s"


def tables_of(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Error over time, the same per modality, and speed."""
    budget = Column("budget", "name")
    length = (Column("seconds", "seconds", ".1f"), Column("steps", "steps", ",d"))
    more = (Column("from", "foreground_from"), Column("aligned", "psnr_aligned", ".2f"), Column("SSIM", "ssim", ".3f"))
    modalities = [{"name": r["name"], "modality": name, **m} for r in rows for name, m in r["scores"]["modalities"].items()]
    return [
        Table("Error over time", (budget, *length, *SCORE_COLUMNS), rows, MEANING),
        Table("Per modality", (budget, Column("modality", "modality"), *PSNR_COLUMNS, *more, *LIGHT_COLUMNS), modalities),
        Table("Speed", (budget, *SPEED_COLUMNS), rows, "Peak memory: of the fit's own process, all of it."),
    ]


def plot(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """PSNR over seconds (log), per modality and their mean; one panel for raw pixels and, where there is one, one for the truth."""
    keys = {"PSNR, raw pixels [dB]": "psnr", "PSNR, noise-free truth in the region of interest [dB]": "psnr_truth"}
    paths = {name: f"scores/modalities/{name}" for row in rows for name in row["scores"]["modalities"]} | {"mean": "mean"}
    panels = {
        label: {name: {row["seconds"]: lookup(row, f"{path}/{key}") for row in rows} for name, path in paths.items()}
        for label, key in keys.items()
    }
    return line_panels(panels, "time of fitting", {row["seconds"]: row["name"] for row in rows})
