"""``mmsynth bench fit``: error over time, one fit from scratch per time budget (the schedules of a fit depend on its length)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from mmsynth.bench.jobs import Job, run_jobs
from mmsynth.bench.machine import measure
from mmsynth.bench.output import Report, new_figure, write_report
from mmsynth.bench.tables import Column, Table, lookup
from mmsynth.errors import InputError
from mmsynth.fitting.recipe import Recipe
from mmsynth.operations.output.progress import Progress

PSNR_COLUMNS = (
    Column("raw [dB]", "mean/psnr", ".2f"),
    Column("truth [dB]", "mean/psnr_truth", ".2f"),
    Column("truth full", "mean/psnr_truth_full", ".2f"),
    Column("foreground", "mean/psnr_foreground", ".2f"),
)
LIGHT_COLUMNS = (
    Column("SAM [°]", "mean/sam", ".2f"),
    Column("AoLP [°]", "mean/aolp_mae", ".2f"),
    Column("DoLP", "mean/dolp_rmse", ".4f"),
)
GEOMETRY_COLUMNS = (
    Column("depth", "scores/geometry/depth_mae", ".4g"),
    Column("normals [°]", "scores/geometry/normal_mae_deg", ".2f"),
    Column("Chamfer", "scores/geometry/chamfer_visible", ".4g"),
)
SPEED_COLUMNS = (
    Column("samples/s", "samples_per_s", ",.0f"),
    Column("rays/s", "rays_per_s", ",.0f"),
    Column("rendered rays/s", "render_rays_per_s", ",.0f"),
    Column("peak memory [MB]", "peak_memory_bytes", ",.0f", 1e-6),
    Column("cpu share", "cpu_share", ".0%"),
    Column("cores", "cores", "d"),
    Column("threads", "threads", "d"),
    Column("seed", "seed", "d"),
    Column("device", "device"),
)
MODALITY_COLUMNS = (
    Column("modality", "modality"),
    Column("raw [dB]", "psnr", ".2f"),
    Column("truth [dB]", "psnr_truth", ".2f"),
    Column("truth full", "psnr_truth_full", ".2f"),
    Column("foreground", "psnr_foreground", ".2f"),
    Column("from", "foreground_from"),
    Column("aligned", "psnr_aligned", ".2f"),
    Column("SSIM", "ssim", ".3f"),
    Column("SAM [°]", "sam", ".2f"),
    Column("AoLP [°]", "aolp_mae", ".2f"),
    Column("DoLP", "dolp_rmse", ".4f"),
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
    return [
        Table("Error over time", (budget, *length, *PSNR_COLUMNS, *LIGHT_COLUMNS, *GEOMETRY_COLUMNS), rows, MEANING),
        Table("Per modality", (budget, *MODALITY_COLUMNS), per_modality(rows)),
        Table("Speed", (budget, *SPEED_COLUMNS), rows, "Peak memory: of the fit's own process, all of it."),
    ]


def per_modality(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per result and modality: ``name, modality`` and the scores of that modality."""
    return [
        {"name": row["name"], "modality": modality, **scores} for row in rows for modality, scores in row["scores"]["modalities"].items()
    ]


def plot(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """PSNR over seconds (log), per modality and their mean; one panel for raw pixels and, where there is one, one for the truth."""
    panels = [("psnr", "PSNR, raw pixels [dB]")]
    if any(lookup(row, "mean/psnr_truth") is not None for row in rows):
        panels.append(("psnr_truth", "PSNR, noise-free truth in the region of interest [dB]"))
    seconds = [row["seconds"] for row in rows]
    figure, axes = new_figure(len(panels))
    for one, (key, label) in zip(axes, panels, strict=True):
        for name in dict.fromkeys(name for row in rows for name in row["scores"]["modalities"]):
            one.plot(seconds, [_value(row, f"scores/modalities/{name}/{key}") for row in rows], ".-", linewidth=1, label=name)
        one.plot(seconds, [_value(row, f"mean/{key}") for row in rows], "o-", color="black", linewidth=2, label="mean")
        one.set(xscale="log", xlabel="time of fitting", ylabel=label)
        one.set_xticks(seconds, [row["name"] for row in rows])
        one.minorticks_off()
        one.legend(frameon=False)
    return figure


def _value(row: Mapping[str, Any], path: str) -> float:
    value = lookup(row, path)
    return float("nan") if value is None else float(value)
