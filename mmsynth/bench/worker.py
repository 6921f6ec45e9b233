"""One fit, measured: the process that ``jobs.run_job`` starts, ``python -m mmsynth.bench.worker TASK FOLDER``.

TASK is the JSON of a ``Job.task``, ``run``, the folder of the fit, and ``began``, the time of day at which it was given; the result is
written to FOLDER/result.json. The process ends when its standard input does, so that the fit of a bench that was killed does not go on
beside the next one: a fit ends with a checkpoint, from which it goes on when it is given the same folder again.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from mmsynth.bench.jobs import scene_of, whole_scene_of
from mmsynth.bench.machine import peak_memory
from mmsynth.errors import known_error
from mmsynth.field.warmup import warm_up
from mmsynth.files import write_json
from mmsynth.fitting.checkpoint import read_checkpoint
from mmsynth.fitting.needs import Needs
from mmsynth.fitting.progress import FitProgress
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import fit
from mmsynth.operations.evaluation.evaluate import evaluate
from mmsynth.operations.output.work_partition import local_device
from mmsynth.prior.prior import load_prior


def work(task: Mapping[str, Any]) -> dict[str, Any]:
    """Fit and score.

    Returns:
        ``seconds``: of the fit, from files to a field on disk, without loading the compiled kernels; ``earlier_seconds``: of it, training
        of processes before this one, which were interrupted. ``steps``. ``rays_per_s, samples_per_s``: of the fit;
        ``render_rays_per_s``: of the test views. Of this process alone ``cpu_share``: processor time by wall time and threads, lower than
        usual on a machine that others use, too; ``startup_seconds``: from the command to the end of the first step, imports and kernels
        included; ``load_seconds``: of it, from files to the first step; ``peak_memory_bytes``: when the fit was done, and on a GPU
        ``peak_gpu_bytes`` that torch held there. ``scores``: of ``evaluate``.
    Raises:
        InputError: as ``fit`` and ``evaluate``.
    """
    device = local_device(task["device"])
    if device == "cpu":
        warm_up()
    if task["input"] != "raw":
        scene_of(task)  # the copy that it takes is made before the clock starts
    prior = None if task["prior"] is None else load_prior(Path(task["prior"]))
    began, cpu = time.perf_counter(), time.process_time()
    started: dict[str, float] = {}

    def loaded(needs: Needs) -> None:
        started["load_seconds"] = time.perf_counter() - began

    def stepped(news: FitProgress) -> None:
        started.setdefault("startup_seconds", time.time() - task["began"])

    scene = scene_of(task)
    length = {"steps": task["steps"], "budget": task["budget"], "seed": task["seed"]}
    run, recipe = Path(task["run"]), Recipe(**task["recipe"])
    earlier = _trained(run)
    field = fit(scene, run, recipe=recipe, **length, device=device, resume=True, prior=prior, on_start=loaded, on_step=stepped)
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    started.setdefault("startup_seconds", time.time() - task["began"])  # no step was left
    peak = {"peak_memory_bytes": peak_memory()}
    if device != "cpu":
        peak["peak_gpu_bytes"] = torch.cuda.max_memory_reserved(device)  # not allocated: what graphs hold counts
    # the whole scene, so that sensors that were not fitted still lend their poses to be scored at, and as it was recorded
    scores = evaluate(field, whole_scene_of(task), views=scene.split.test)
    return {
        "seconds": earlier + seconds,
        "earlier_seconds": earlier,
        "cpu_share": cpu / (seconds * torch.get_num_threads()),
        **started,
        **peak,
        **{key: field.manifest[key] for key in ("steps", "rays_per_s", "samples_per_s")},
        "render_rays_per_s": scores["rays_per_s"],
        "scores": scores,
    }


def _trained(run: Path) -> float:
    """Seconds of training that are in a run's checkpoint."""
    saved = read_checkpoint(run)
    return 0.0 if saved is None else float(saved["state"]["elapsed"])


def serve(work: Callable[[Mapping[str, Any]], dict[str, Any]]) -> None:
    """Read the arguments, work on the task, write the result; an error becomes one sentence and its exit code."""

    def end_with_the_parent() -> None:
        while os.read(0, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # what started the bench may ignore it
    threading.Thread(target=end_with_the_parent, daemon=True).start()
    task, folder = json.loads(sys.argv[1]), Path(sys.argv[2])
    try:
        write_json(folder / "result.json", work(task))
    except Exception as error:
        known = known_error(error, "bench")
        if known is None:
            raise
        print(f"error: {known}", file=sys.stderr)
        raise SystemExit(known.exit_code) from None


if __name__ == "__main__":
    serve(work)
