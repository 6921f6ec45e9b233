"""``mmsynth bench ablation``: what each choice is worth, in seconds and dB, against a baseline at the same length and seeds.

A table is a TOML file of variants, the first of which is the baseline and changes nothing:

    [[variant]]
    name = "baseline"

    [[variant]]
    name = "coarse"
    why = "one line: what the change should tell"
    recipe = { radiance.cells_per_pixel = 0.5 }    # keys of the recipe, by section
    modalities = ["rgb", "ms"]           # fit these alone; left out: all
    frames = { pol = 3 }                 # training frames to keep
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mmsynth.bench.fit import SCORE_COLUMNS, SPEED_COLUMNS
from mmsynth.bench.jobs import Job, mean_over_modalities, run_jobs
from mmsynth.bench.machine import measure
from mmsynth.bench.output import Report, new_figure, write_report
from mmsynth.bench.tables import Column, Table, lookup, numbers
from mmsynth.errors import InputError
from mmsynth.fitting.recipe import Recipe, recipe_path
from mmsynth.operations.output.progress import Progress
from mmsynth.packaged import data_folder
from mmsynth.scene.scene import canonical_modality
from mmsynth.toml import first_problem, read_toml


class Variant(BaseModel):
    """One line of a table; see the module docstring."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=r"^[\w.+-]+$")
    why: str = ""
    recipe: dict[str, dict[str, Any]] = {}
    modalities: list[str] | None = None
    frames: dict[str, int] = {}

    @property
    def changes(self) -> dict[str, Any]:
        """What it changes, by name."""
        recipe = {f"{section}.{key}": value for section, keys in self.recipe.items() for key, value in keys.items()}
        return recipe | self.model_dump(include={"modalities", "frames"}, exclude_defaults=True)

    def fitted_recipe(self) -> Recipe:
        """The default recipe with the changes."""
        return Recipe.model_validate(self.recipe)


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")

    variant: list[Variant] = Field(min_length=1)


def load_table(name_or_path: str) -> list[Variant]:
    """A packaged table by name (``recipes/bench``), or a TOML file.

    Raises:
        InputError: no such table, broken TOML, an unknown key of a variant or of the recipe, a value out of range, a name used twice, or
            a baseline that changes something.
    """
    path = recipe_path(name_or_path, data_folder("recipes") / "bench", "table")
    variants = read_toml(path, _File).variant
    for variant in variants:
        try:
            variant.fitted_recipe()
        except ValidationError as error:
            raise InputError(f"{path}: variant {variant.name!r}: recipe.{first_problem(error)}.") from error
    names = [variant.name for variant in variants]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{path}: variant {name!r} is there twice, expected one of each name.")
    if variants[0].changes:
        raise InputError(f"{path}: variant {names[0]!r} is the first and so the baseline, which must change nothing.")
    return variants


def bench_ablation(
    scene: Path | str,
    table: str,
    out: Path,
    steps: int | None = None,
    budget: float | None = None,
    seeds: Sequence[int] = (0,),
    only: Sequence[str] | None = None,
    progress: Progress | None = None,
    device: str = "cpu",
) -> Report:
    """Fit and score every variant of a table with every seed; the report in ``out`` is renewed after every fit (see ``jobs``).

    Args:
        table: as for ``load_table``. steps, budget [s]: length of every fit; exactly one. only: names of variants; None: all. The
            baseline is always among them. progress: called with (fits done, fits in all).
    Raises:
        InputError: both or neither length, an unknown variant, no seed or one twice, a table, scene or fit that is refused, or ``out``
            cannot be written.
    """
    if (steps is None) == (budget is None):
        raise InputError("ablation: give either a number of steps or a time budget, not both.")
    if not seeds or len(set(seeds)) < len(seeds):
        raise InputError(f"seeds {', '.join(map(str, seeds)) or 'none'}: expected one or more, each once.")
    variants = _chosen(load_table(table), only)
    # seed by seed: a bench that was stopped has compared as many variants as it could
    fits = [(v, seed) for seed in seeds for v in variants]
    jobs = [
        Job(f"{v.name}-seed{seed}", str(scene), v.fitted_recipe(), _canonical(v.modalities), v.frames, seed, steps, budget, device)
        for v, seed in fits
    ]
    results: dict[str, Any] = {"bench": "ablation", "scene": str(scene), "table": table, "machine": measure(), "rows": []}
    for (variant, _), row in zip(fits, run_jobs(jobs, out, progress), strict=True):
        results["rows"].append({**row, "variant": variant.name})
        results["variants"] = compare(variants, results["rows"])
        report = write_report(results, tables_of(results["variants"]), plot(results["variants"]), out)
    return report


def _chosen(variants: Sequence[Variant], only: Sequence[str] | None) -> list[Variant]:
    known = [variant.name for variant in variants]
    for name in only or ():
        if name not in known:
            raise InputError(f"--only {name!r}: no such variant, expected some of {', '.join(known)}.")
    return [variant for i, variant in enumerate(variants) if only is None or i == 0 or variant.name in only]


def _canonical(modalities: Sequence[str] | None) -> tuple[str, ...] | None:
    return None if modalities is None else tuple(canonical_modality(name) for name in modalities)


# ----------------------------------------------------------------------------------------------------------------- the arithmetic

_NUMBERS = ("seconds", "steps", "samples_per_s", "rays_per_s", "render_rays_per_s", "peak_memory_bytes", "cpu_share")


def compare(variants: Sequence[Variant], rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Results of fits → one summary per variant that has any.

    Args:
        rows: of ``run_jobs``, each with its ``variant``; the first variant is the baseline.
    Returns:
        per variant ``name, why, changes, seeds, cores, threads``, the means over the seeds of every number of a row (``scores`` too),
        and ``difference``, the variant minus the baseline of the same seed: of ``seconds``, of every score (mean over the modalities
        that both have; each in ``modalities``) and of ``geometry``. A difference is ``{"mean", "spread"}`` over the seeds; the spread
        is the standard deviation, None for one seed.
    """
    baseline = {row["seed"]: row for row in rows if row["variant"] == variants[0].name}
    out = []
    for variant in variants:
        mine = [row for row in rows if row["variant"] == variant.name]
        if not mine:
            continue
        summary: dict[str, Any] = {"name": variant.name, "why": variant.why, "changes": variant.changes, "seeds": len(mine)}
        summary |= {key: mine[0][key] for key in ("cores", "threads")}
        summary |= {key: statistics.fmean(row[key] for row in mine) for key in _NUMBERS}
        summary["scores"] = _merge([_numbers(row["scores"]) for row in mine], statistics.fmean)
        summary["mean"] = mean_over_modalities(summary["scores"])
        if variant is not variants[0]:
            pairs = [_minus(row, baseline[row["seed"]]) for row in mine if row["seed"] in baseline]
            summary["difference"] = _merge(pairs, _mean_and_spread)
        out.append(summary)
    return out


def _numbers(scores: Mapping[str, Any]) -> dict[str, Any]:
    """What can be averaged of an evaluation: modality → score → number, and the geometry's."""
    modalities = {n: {k: v for k, v in m.items() if isinstance(v, float)} for n, m in scores["modalities"].items()}
    return {"modalities": modalities, "geometry": dict(scores["geometry"])}


def _minus(row: Mapping[str, Any], baseline: Mapping[str, Any]) -> dict[str, Any]:
    """Row minus baseline where both have a number."""
    apart = _merge([_numbers(row["scores"]), _numbers(baseline["scores"])], lambda pair: pair[0] - pair[1])
    return {"seconds": row["seconds"] - baseline["seconds"], **mean_over_modalities(apart), **apart}


def _merge(trees: Sequence[Mapping[str, Any]], join: Any) -> dict[str, Any]:
    """Nested dictionaries of one shape → one, ``join`` of the numbers at each leaf that all of them have."""
    if not trees:
        return {}
    keys = [key for key in trees[0] if all(key in tree for tree in trees)]
    columns = {key: [tree[key] for tree in trees] for key in keys}
    return {key: _merge(values, join) if isinstance(values[0], Mapping) else join(values) for key, values in columns.items()}


def _mean_and_spread(values: Sequence[float]) -> dict[str, float | None]:
    return {"mean": statistics.fmean(values), "spread": statistics.stdev(values) if len(values) > 1 else None}


# --------------------------------------------------------------------------------------------------------------------- the report


def tables_of(variants: Sequence[Mapping[str, Any]]) -> list[Table]:
    """What ``compare`` gave: differences, scores, the same per modality, speed, and what the variants change."""
    name, seeds = Column("variant", "name"), Column("seeds", "seeds", "d")
    differences = (
        Column("seconds", "seconds", ".1f"),
        Column("Δ seconds", "difference/seconds", "+.1f"),
        *numbers(",.0f", {"steps": "steps", "samples/s": "samples_per_s"}),
        *numbers(".2f", {"raw [dB]": "mean/psnr", "truth [dB]": "mean/psnr_truth"}),
        *numbers("+.2f", {"Δ raw [dB]": "difference/psnr", "Δ truth [dB]": "difference/psnr_truth"}),
        Column("Δ Chamfer", "difference/geometry/chamfer_visible", "+.2g"),
    )
    together = {"together over alone, raw [dB]": "together/psnr", "together over alone, truth [dB]": "together/psnr_truth"}
    per_modality = (
        Column("modality", "modality"),
        *numbers(".2f", {"raw [dB]": "psnr", "truth [dB]": "psnr_truth"}),
        *numbers("+.2f", {"Δ raw [dB]": "difference/psnr", "Δ truth [dB]": "difference/psnr_truth"} | together),
    )
    changes = [{**v, "changed": ", ".join(f"{key} = {value}" for key, value in v["changes"].items()) or "nothing"} for v in variants]
    spread = "Δ: the variant minus the baseline of the same seed, over the modalities that both have; ±: standard deviation over the seeds."
    alone = "Together over alone: what the baseline's other modalities give to one that a variant fits alone."
    return [
        Table("Against the baseline", (name, seeds, *differences), variants, spread),
        Table("Scores", (name, *SCORE_COLUMNS), variants, "Means over the seeds."),
        Table("Per modality", (name, *per_modality), _per_modality(variants), alone),
        Table("Speed", (name, *(c for c in SPEED_COLUMNS if c.path != "seed")), variants),
        Table("Variants", (name, Column("changes", "changed"), Column("why", "why")), changes),
    ]


def _per_modality(variants: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per variant and modality; where a variant has one alone, ``together`` is what the baseline has more than it."""
    rows = []
    for variant in variants:
        modalities = variant["scores"]["modalities"]
        for name, scores in modalities.items():
            difference = lookup(variant, f"difference/modalities/{name}")
            row = {"name": variant["name"], "modality": name, **scores, "difference": difference}
            if difference and len(modalities) == 1:
                row["together"] = {key: {**value, "mean": -value["mean"]} for key, value in difference.items()}
            rows.append(row)
    return rows


def plot(variants: Sequence[Mapping[str, Any]]) -> Figure:
    """Bars per variant with their spread: difference to the baseline in PSNR and in seconds."""
    panels = [("psnr", "Δ PSNR, raw pixels [dB]"), ("psnr_truth", "Δ PSNR, noise-free truth [dB]"), ("seconds", "Δ seconds of fitting")]
    compared = [v for v in variants if v.get("difference")]
    panels = [(key, label) for key, label in panels if key != "psnr_truth" or any(key in v["difference"] for v in compared)]
    figure, axes = new_figure(len(panels), height=1.2 + 0.25 * len(compared))
    for one, (key, label) in zip(axes, panels, strict=True):
        found = {v["name"]: v["difference"][key] for v in compared if key in v["difference"]}
        one.barh(list(found), [d["mean"] for d in found.values()], xerr=[d["spread"] or 0.0 for d in found.values()])
        one.axvline(0, color="black", linewidth=1)
        one.invert_yaxis()
        one.set(xlabel=label)
    return figure
