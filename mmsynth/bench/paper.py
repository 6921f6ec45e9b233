"""``mmsynth bench paper``: the tables of MultimodalStudio (CVPR 2025) and SPOiLeR (ECCV 2026), on any scenes.

A row of a table is an experiment, a column a modality; a cell is the mean over scenes of a score on the test views, as they were recorded.
Fits that several rows or tables ask for are made once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from mmsynth.bench.experiments import Experiment, Fit, Row, fit_of, load_experiments
from mmsynth.bench.fit import budget_name
from mmsynth.bench.jobs import Job, finished_result_of, result_of, scene_hashes
from mmsynth.bench.machine import measure
from mmsynth.bench.output import Report, write_report
from mmsynth.bench.tables import Column, Table
from mmsynth.errors import DivergedError, InputError
from mmsynth.fitting.recipe import Recipe
from mmsynth.operations.evaluation.perceptual import find_lpips
from mmsynth.operations.output.progress import Counter, Progress
from mmsynth.operations.output.work_partition import WorkPartition
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import MaskMeaning, Scene

_SCORES = {
    "psnr": ("PSNR, pooled [dB]", ".2f"),
    "psnr_view_mean": ("PSNR, mean over views [dB]", ".2f"),
    "psnr_foreground": ("foreground, pooled [dB]", ".2f"),
    "psnr_foreground_view_mean": ("foreground, mean over views [dB]", ".2f"),
    "ssim": ("SSIM", ".3f"),
    "lpips": ("LPIPS", ".3f"),
    "seconds": ("seconds of the fit", ".1f"),
    "steps": ("steps of the fit", ",.0f"),
}
"""What a table shows: label and format."""
MEANING = (
    "A column is the modality that is scored, on the raw frames of the test views through their lenses; a cell is the mean over scenes; "
    "'mean' is over the modalities, where a row has all. Pooled: dB of the mean error of all test views; mean over views: the mean of each "
    "view's dB. Foreground: within masks, or where ground truth has its first hit in the region."
)


@dataclass(frozen=True)
class Cell:
    """Where a number of a table comes from: a row, the modality of a column, and the fit of one scene."""

    table: str
    row: Row
    modality: str
    scene: str
    fit: Fit


@dataclass(frozen=True)
class Plan:
    """All that is to be done.

    Attributes:
        experiments: tables by name. scenes: by the names of their folders. cells: of all tables. jobs: in the order in which they are
            made, by scene, fit and seed.
    """

    experiments: dict[str, Experiment]
    scenes: dict[str, Scene]
    cells: list[Cell]
    jobs: dict[tuple[str, Fit, int], Job]

    @property
    def modalities(self) -> list[str]:
        """Of all scenes, in the order in which they appear."""
        return list(dict.fromkeys(name for scene in self.scenes.values() for name in scene.sensors))


def bench_paper(
    scenes: Sequence[Path],
    out: Path,
    recipe: Recipe,
    tables: Sequence[str] | None = None,
    steps: int | None = None,
    budget: float | None = None,
    seeds: Sequence[int] = (0,),
    masks: MaskMeaning | None = None,
    mask_folder: Path | None = None,
    device: str = "cpu",
    part: WorkPartition | None = None,
    progress: Progress | None = None,
    prior: Path | None = None,
) -> Report:
    """Fit and score what the tables ask for, and make them.

    Every fit has a process of its own and a result in ``out/rows``, and what is there is not fitted again (``jobs``), whatever machine made
    it. A fit that fails stops no other; it is tried again the next time. The report in ``out`` is renewed after every fit or, where several
    processes share the work, written by those that find everything finished.

    Args:
        tables: names of packaged tables, or TOML files; None: all. steps, budget [s]: length of every fit; exactly one. With steps every
            modality has as many rays a step in a fit of few modalities as in one of all, as the papers have it; with a budget every fit
            has the same time.
        masks, mask_folder: as for ``load_scene``. part: the fits of this process, None: all. progress: called with (fits done, fits).
        prior: file of rows that have one, None: these are left out.
    Returns:
        ``results`` with ``rows`` (what ``jobs.run_jobs`` gives of every fit, with ``scene`` and ``fit``), ``tables``, ``unfinished``
        and ``failed``: names of fits, and sentences by name; ``notes``: sentences. No files where others are still at work.
    Raises:
        InputError: both or neither length, no scene or two of one name, a scene or table that cannot be read, no table with a row for
            these scenes, no seed or one twice, or ``out`` cannot be written.
    """
    if (steps is None) == (budget is None):
        raise InputError("paper: give either a number of steps or a time budget, not both.")
    if not seeds or len(set(seeds)) < len(seeds):
        raise InputError(f"seeds {', '.join(map(str, seeds)) or 'none'}: expected one or more, each once.")
    part = part or WorkPartition()

    def job(path: Path, scene: Scene, fit: Fit, seed: int) -> Job:
        known = len(scene.sensors)
        chosen = None if len(fit.modalities) == known else fit.modalities
        return Job(
            f"{path.resolve().name}-{fit.name}-seed{seed}", str(path), fit.recipe(recipe, known if budget is None else None), chosen,
            dict(fit.frames), seed, steps, budget, device, masks=masks,
            mask_folder=None if mask_folder is None else str(mask_folder), input=fit.input, prepared=str(out / "prepared"),
            any_machine=True, prior=str(prior) if fit.prior else None,
        )  # fmt: skip

    experiments, read = load_experiments(tables), _read_scenes(scenes, masks, mask_folder)
    cells = cells_of(experiments, {name: scene for name, (_, scene) in read.items()}, priors=prior is not None)
    fits = list(dict.fromkeys((cell.scene, cell.fit) for cell in cells))
    jobs = {(name, fit, seed): job(*read[name], fit, seed) for seed in seeds for name, fit in fits}
    plan = Plan(experiments, {name: scene for name, (_, scene) in read.items()}, cells, jobs)
    hashes = scene_hashes(list(jobs.values()))
    length = f"{steps} steps" if budget is None else budget_name(budget)
    results: dict[str, Any] = {
        "bench": "paper", "scenes": {name: str(path) for name, (path, _) in read.items()}, "length": length, "seeds": list(seeds),
        "machine": measure(), "failed": {},
    }  # fmt: skip
    mine = [list(jobs.items())[index] for index in part.of(len(jobs))]
    found: dict[tuple[str, Fit, int], dict[str, Any]] = {}
    count = Counter(progress, len(mine))
    count(0)
    for key, one in mine:
        try:
            found[key] = result_of(one, hashes[one.scene], out)
        except (InputError, DivergedError) as error:
            results["failed"][one.name] = str(error)
        count(1)
        if part.processes == 1:
            report = _report(plan, found, results, out)
    if part.processes == 1:
        return report
    others = {key: finished_result_of(one, hashes[one.scene], out) for key, one in jobs.items() if key not in found}
    return _report(plan, found | {key: row for key, row in others.items() if row is not None}, results, out, only_if_finished=True)


def cells_of(experiments: Mapping[str, Experiment], scenes: Mapping[str, Scene], priors: bool = False) -> list[Cell]:
    """Every number that the tables can have on these scenes, ``priors``: those with a prior, too.

    Raises:
        InputError: there is none.
    """
    modalities = list(dict.fromkeys(name for scene in scenes.values() for name in scene.sensors))
    cells = [
        Cell(table, row, modality, name, fit)
        for table, experiment in experiments.items()
        for given in experiment.row
        for row in given.repeated(modalities)
        if priors or not row.prior
        for modality in modalities
        for name, scene in scenes.items()
        if (fit := fit_of(row, modality, scene)) is not None
    ]
    if not cells:
        raise InputError(
            f"tables {', '.join(experiments)}: none of their rows can be fitted to {', '.join(scenes)}, with {', '.join(modalities)}."
        )
    return cells


def _read_scenes(paths: Sequence[Path], masks: MaskMeaning | None, mask_folder: Path | None) -> dict[str, tuple[Path, Scene]]:
    """By the names of their folders, which the tables state."""
    found: dict[str, tuple[Path, Scene]] = {}
    for path in paths:
        name = path.resolve().name
        if name in found:
            raise InputError(f"{path}: two scenes are called '{name}', expected folders whose names differ.")
        found[name] = path, load_scene(path, masks=masks, mask_folder=mask_folder)
    if not found:
        raise InputError("paper: no scene given, expected at least one.")
    return found


# ----------------------------------------------------------------------------------------------------------------- the arithmetic

Rows = Mapping[tuple[str, Fit, int], Mapping[str, Any]]
"""Results of fits by scene, fit and seed, as ``jobs.result_of`` gives them."""


def score_of(result: Mapping[str, Any], modality: str, score: str) -> float | None:
    """One number of a result, None where the field has no such modality; no foreground by its own opacity, which differs from fit to
    fit."""
    scores = result["scores"]["modalities"].get(modality)
    if scores is None:
        return None
    if score in ("seconds", "steps"):
        return float(result[score])
    if score.startswith("psnr_foreground") and scores.get("foreground_from") == "opacity":
        return None
    return scores.get(score)


def mean_of(cells: Sequence[Cell], found: Rows, seeds: Sequence[int], score: str) -> float | None:
    """Mean over scenes of the mean over seeds; None where there is no cell, or one of its fits has no such score (yet)."""
    means = []
    for cell in cells:
        result = [found.get((cell.scene, cell.fit, seed)) for seed in seeds]
        values = [None if one is None else score_of(one, cell.modality, score) for one in result]
        if any(value is None for value in values):
            return None
        means.append(fmean(value for value in values if value is not None))
    return fmean(means) if means else None


def lines_of(cells: Sequence[Cell], modalities: Sequence[str], found: Rows, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """The lines of a table.

    Args:
        cells: of one table.
    Returns:
        one for each score and row that has any: ``score, row, scenes`` (how many), ``modalities`` (name → mean over scenes), and ``mean``
        of these where there are all.
    """
    lines: list[dict[str, Any]] = []
    names = dict.fromkeys(cell.row.name for cell in cells)
    for score in _SCORES:
        for name in names:
            of_row = [cell for cell in cells if cell.row.name == name]
            means = {m: mean_of([cell for cell in of_row if cell.modality == m], found, seeds, score) for m in modalities}
            known = {m: value for m, value in means.items() if value is not None}
            if known:
                mean = {"mean": fmean(known.values())} if len(known) == len(modalities) else {}
                scenes = len({cell.scene for cell in of_row})
                lines.append({"score": score, "row": name, "scenes": scenes, "modalities": known, **mean})
    return lines


# --------------------------------------------------------------------------------------------------------------------- the report


def _report(plan: Plan, found: Rows, results: dict[str, Any], out: Path, only_if_finished: bool = False) -> Report:
    """What is known now, made into tables and written."""
    results = results | {
        "rows": [{**found[key], "scene": key[0], "fit": key[1].name} for key in plan.jobs if key in found],
        "unfinished": [job.name for key, job in plan.jobs.items() if key not in found],
        "tables": [],
        "notes": [],
    }
    shown = []
    for table, experiment in plan.experiments.items():
        cells = [cell for cell in plan.cells if cell.table == table]
        if not cells:
            results["notes"].append(f"table {table!r} is left out: no scene has the modalities, frames, mosaics or lenses for it.")
            continue
        lines = lines_of(cells, plan.modalities, found, results["seeds"])
        note = _note(experiment, cells, plan, found, results)
        results["tables"].append({"name": table, "title": experiment.title, "source": experiment.source, "note": note, "lines": lines})
        shown.append(_table(experiment, lines, plan.modalities, note))
    results["notes"] += _notes(plan, results)
    if results["unfinished"] and only_if_finished:
        return Report(results, [], out)
    first = shown[0]
    tables = [Table(first.title, first.columns, first.rows, f"{first.note} {MEANING}"), *shown[1:]]
    return write_report(results, tables, None, out)


def _table(experiment: Experiment, lines: Sequence[Mapping[str, Any]], modalities: Sequence[str], note: str) -> Table:
    """Numbers of one column have several formats: they are texts here, and to the right all the same (">")."""
    rows = []
    for line in lines:
        label, form = _SCORES[line["score"]]
        texts = {name: f"{value:{form}}" for name, value in line["modalities"].items()}
        mean = {"mean": f"{line['mean']:{form}}"} if "mean" in line else {}
        rows.append({"row": line["row"], "score": label, "of": texts, "scenes": line["scenes"], **mean})
    columns = [Column("score", "score"), Column("fitted", "row"), *(Column(name, f"of/{name}", ">") for name in modalities)]
    return Table(experiment.title, [*columns, Column("mean", "mean", ">"), Column("scenes", "scenes", "d")], rows, note)


def _note(experiment: Experiment, cells: Sequence[Cell], plan: Plan, found: Rows, results: Mapping[str, Any]) -> str:
    """Scenes, length, seconds, cores and seeds of a table, and what it leaves out."""
    used = [found[key] for key in dict.fromkeys((c.scene, c.fit, s) for c in cells for s in results["seeds"]) if key in found]
    scenes, seeds = ", ".join(dict.fromkeys(cell.scene for cell in cells)), ", ".join(map(str, results["seeds"]))
    told = [f"After {experiment.source}.", experiment.note, f"Scenes: {scenes}; {results['length']} a fit; seed {seeds}."]
    if used:
        seconds, cores = [row["seconds"] for row in used], sorted({(row["cores"], row["threads"]) for row in used})
        where = " and ".join(f"{c} cores, {t} {'thread' if t == 1 else 'threads'}" for c, t in cores)
        told.append(f"{len(used)} fits of {min(seconds):.0f} to {max(seconds):.0f} s, {sum(seconds):.0f} s in all, on {where}.")
    rows = [row.name for given in experiment.row for row in given.repeated(plan.modalities) if not row.prior]
    absent = [name for name in rows if name not in {cell.row.name for cell in cells}]
    if absent:
        told.append(f"Left out, as no scene has the modalities, frames, mosaics or lenses for them: {'; '.join(absent)}.")
    return " ".join(filter(None, told))


def _notes(plan: Plan, results: Mapping[str, Any]) -> list[str]:
    """Sentences on what is not there."""
    told = [f"{name} failed: {error}" for name, error in results["failed"].items()]
    waiting = len(results["unfinished"]) - len(results["failed"])
    if waiting > 0:
        told.append(f"{waiting} of {len(plan.jobs)} fits are not finished; run the command again when they are.")
    if find_lpips() is None:
        told.append("no LPIPS: lpips or torchmetrics, with torchvision and AlexNet's weights, is not installed, and nothing is downloaded.")
    return told
