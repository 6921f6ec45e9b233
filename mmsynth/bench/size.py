"""``mmsynth bench size``: one scene at several sizes, up to that of real sensors (``full_size``): error over time, start-up, memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from mmsynth.bench.fit import PSNR_COLUMNS, budget_name
from mmsynth.bench.full_size import FULL_WIDTH, make_full_size, views_to_make
from mmsynth.bench.jobs import Job, run_jobs
from mmsynth.bench.machine import measure
from mmsynth.bench.output import Report, line_panels, write_report
from mmsynth.bench.tables import Column, Table, lookup, numbers
from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.fitting.recipe import Recipe
from mmsynth.operations.output.progress import Progress, parts
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene


def make_scenes(
    field: Field,
    scene: Scene,
    scales: Sequence[Fraction],
    out: Path,
    *,
    width: int = FULL_WIDTH,
    views: int | None = None,
    progress: Progress | None = None,
) -> dict[Fraction, Path]:
    """The scenes of all scales in ``out/scenes``, by scale; what is there already is not rendered again (``make_full_size``).

    Args:
        scales: of ``width``, pixels in a row. views: how many of the scene's; None: all. progress: called with thousandths of the rays.
    Raises:
        InputError: a scale that is not above 0, or twice; as ``make_full_size``.
    """
    if not scales or len(set(scales)) < len(scales) or min(scales) <= 0:
        raise InputError(f"scales {', '.join(map(str, scales)) or 'none'}: expected one or more above 0, each once.")
    views_to_make(scene, views)  # that there are so many is known before the first is rendered
    whole = float(sum(scale**2 for scale in scales))
    shares = parts(progress, [float(scale**2) / whole for scale in scales])
    return {
        scale: make_full_size(
            field, scene, out / "scenes" / _file_name(scale), scale=float(scale), width=width, views=views, progress=share
        ).parent
        for scale, share in zip(scales, shares, strict=True)
    }


def bench_size(
    scenes: Mapping[Fraction, Path],
    budgets: Sequence[float],
    out: Path,
    recipe: Recipe,
    seed: int = 0,
    progress: Progress | None = None,
    device: str = "cpu",
) -> Report:
    """Fit each scene from scratch once per budget and score it; the report in ``out`` is renewed after every fit.

    Fits whose result already lies in ``out`` are not made again (``jobs``).

    Args:
        scenes: by scale, see ``make_scenes``. budgets: training times, seconds. progress: called with (fits done, fits in all).
    Raises:
        InputError: a budget twice; a fit that fails; ``out`` cannot be written.
    """
    budgets = sorted(budgets)
    if not budgets or len(set(budgets)) < len(budgets):
        raise InputError(f"budgets {', '.join(map(budget_name, budgets)) or 'none'}: expected one or more, each once.")
    asked = [(budget, scale) for budget in budgets for scale in sorted(scenes)]  # the shortest first: there is a table soon
    jobs = [
        Job(f"{_file_name(scale)}-{budget_name(budget)}", str(scenes[scale]), recipe, None, {}, seed, None, budget, device)
        for budget, scale in asked
    ]
    photosites = {scale: _photosites(load_scene(path)) for scale, path in scenes.items()}
    results: dict[str, Any] = {"bench": "size", "scenes": {str(s): str(p) for s, p in scenes.items()}, "machine": measure(), "rows": []}
    for (budget, scale), row in zip(asked, run_jobs(jobs, out, progress), strict=True):
        results["rows"].append({**row, "scale": str(scale), "budget": budget_name(budget), "photosites": photosites[scale]})
        report = write_report(results, tables_of(results["rows"]), plot(results["rows"]), out)
    return report


def _file_name(scale: Fraction) -> str:
    return str(scale).replace("/", "-")


def _photosites(scene: Scene) -> int:
    """Of the frames that train."""
    return sum(frame.camera.width * frame.camera.height for frame in scene.frames if frame.view in scene.split.train)


def tables_of(rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    """What a time buys at each size, and what a size costs before the first step and in memory."""
    which = (Column("scale", "scale"), Column("photosites [M]", "photosites", ",.1f", 1e-6), Column("budget", "budget"))
    psnr = tuple(Column(column.heading, f"mean/{column.path}", column.form) for column in PSNR_COLUMNS)
    length = (Column("seconds", "seconds", ".1f"), Column("steps", "steps", ",d"), Column("rays/s", "rays_per_s", ",.0f"))
    start = numbers(".1f", {"start-up [s]": "startup_seconds", "of it loading [s]": "load_seconds"})
    memory = (Column("peak memory [MB]", "peak_memory_bytes", ",.0f", 1e-6), Column("rendered rays/s", "render_rays_per_s", ",.0f"))
    modalities = [
        {"scale": row["scale"], "photosites": row["photosites"], "budget": row["budget"], "modality": name, **scores}
        for row in rows
        for name, scores in row["scores"]["modalities"].items()
    ]
    return [
        Table(
            "Error over time, by size",
            (*which, *length, *psnr),
            rows,
            f"Scale 1 has {FULL_WIDTH} pixels in a row. PSNR: means over the modalities, on the test views of that size; raw: against "
            "pixels with noise, truth: against the light that they were made of, in the region of interest. Photosites: those that train.",
        ),
        Table("Per modality", (*which, Column("modality", "modality"), *PSNR_COLUMNS, Column("SSIM", "ssim", ".3f")), modalities),
        Table(
            "Start and memory",
            (*which, *start, *memory),
            rows,
            "Start-up: from the command to the end of the first step. Peak memory: of the fit's own process, all of it.",
        ),
    ]


def plot(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """PSNR, the mean of the modalities, over seconds (log), a line per size."""
    keys = {"PSNR, raw pixels [dB]": "mean/psnr", "PSNR, noise-free truth in the region of interest [dB]": "mean/psnr_truth"}
    scales = list(dict.fromkeys(row["scale"] for row in rows))
    panels = {
        label: {scale: {row["seconds"]: lookup(row, key) for row in rows if row["scale"] == scale} for scale in scales}
        for label, key in keys.items()
    }
    return line_panels(panels, "time of fitting", {row["seconds"]: row["budget"] for row in rows})
