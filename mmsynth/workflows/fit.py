"""A fit and its scores, each with the run's report."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mmsynth.field.field import Field
from mmsynth.fitting.needs import Needs
from mmsynth.fitting.progress import FitProgress
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import CHECKPOINT_EVERY, fit
from mmsynth.fitting.stored_frames import OnLoad
from mmsynth.operations.evaluation.evaluate import evaluate
from mmsynth.operations.output.progress import Progress
from mmsynth.prior.prior import Prior
from mmsynth.report.report import write_run_report
from mmsynth.scene.exposure import Exposure
from mmsynth.scene.scene import Scene
from mmsynth.workflows.runs import Run, mark_latest, new_run, run_to_resume


def fit_run(
    scene: Scene,
    folder: Path | None = None,
    *,
    recipe: Recipe | str | None = None,
    steps: int | None = None,
    budget: float | None = None,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    prior: Prior | None = None,
    exposure: Exposure | None = None,
    checkpoint_every: float = CHECKPOINT_EVERY,
    on_load: OnLoad | None = None,
    on_start: Callable[[Needs], None] | None = None,
    on_step: Callable[[FitProgress], None] | None = None,
    on_field: Callable[[Path, Field], None] | None = None,
) -> Run:
    """Fit a scene into a run folder with its report, and let ``runs/latest`` be it.

    Args:
        folder: None: a new one in ``runs``, or with ``resume`` the scene's run whose checkpoint is the newest. The others: see ``fit``;
            on_field is given the folder, too.
    Raises:
        InputError: as ``fit``, or there is nothing to resume. Others: as ``fit``.
    """
    name = scene.root.resolve().name
    folder = folder or (run_to_resume(name) if resume else new_run(name))
    field = fit(
        scene,
        folder,
        recipe=recipe,
        steps=steps,
        budget=budget,
        seed=seed,
        device=device,
        resume=resume,
        prior=prior,
        exposure=exposure,
        checkpoint_every=checkpoint_every,
        on_load=on_load,
        on_start=on_start,
        on_step=on_step,
        on_field=None if on_field is None else functools.partial(on_field, folder),
    )
    write_run_report(folder, field, scene=scene)
    mark_latest(folder)
    return Run(folder, field, scene)


def evaluate_run(run: Run, *, progress: Progress | None = None) -> dict[str, Any]:
    """``evaluate`` on the scene's test views; the scores go into the run's report.

    Raises:
        InputError: as ``evaluate``.
    """
    scores = evaluate(run.field, run.scene, progress=progress)
    write_run_report(run.folder, run.field, evaluation=scores, scene=run.scene)
    return scores
