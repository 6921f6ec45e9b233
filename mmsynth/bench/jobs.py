"""Fits to be measured, each in a process of its own, each result on disk as soon as it is there.

A result lies in ``OUT/rows/<name>-<digest>.json``, and the digest is that of everything the result depends on (``identity``): pixels,
poses, truth, recipe, length, seed, the package's own code, its libraries, the machine. So a result on disk is never out of date, and a
benchmark that was interrupted continues where it was, in the middle of a fit, too: until there is a result, the folder
``OUT/rows/<name>-<digest>`` is that of the run.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mmsynth.bench.machine import identify
from mmsynth.errors import DivergedError, InputError
from mmsynth.files import read_json, write_json
from mmsynth.fitting.recipe import Recipe
from mmsynth.operations.export.demosaicked import write_demosaicked
from mmsynth.operations.output.progress import Counter, Progress
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import MaskMeaning, Scene, keep_frames

Input = Literal["raw", "demosaicked"]
"""What is learned from: frames as they were recorded, or demosaicked and undistorted ones (``write_demosaicked``)."""

_PACKAGE = Path(__file__).parents[1]
# what a fit and its score run through
_CODE = ("field", "fitting", "prior", "scene", "sensors", "operations/evaluation", "operations/export/demosaicked.py", "bench/worker.py")
# of a task, where files are: the identity has what is in them
_PLACES = ("scene", "mask_folder", "prepared", "prior")


@dataclass(frozen=True)
class Job:
    """One fit from scratch and its score.

    Attributes:
        name: unique in its bench; names the file of the result. scene: folder or JSON file.
        modalities: names to fit; None: all. frames: modality → training frames to keep (``keep_frames``).
        steps, budget: length in optimiser steps, or in seconds; one of the two. device: cpu or cuda.
        masks, mask_folder: as for ``load_scene``. input: what is learned from; scored on the frames as they were recorded in any case.
        prepared: folder for copies of scenes that another ``input`` takes. any_machine: a result counts on whatever machine it was made.
        prior: file that tells the modalities that are not fitted, None: nothing does.
    """

    name: str
    scene: str
    recipe: Recipe
    modalities: tuple[str, ...] | None
    frames: Mapping[str, int]
    seed: int
    steps: int | None
    budget: float | None
    device: str = "cpu"
    masks: MaskMeaning | None = None
    mask_folder: str | None = None
    input: Input = "raw"
    prepared: str = "prepared"
    any_machine: bool = False
    prior: str | None = None

    def task(self) -> dict[str, Any]:
        """What the child process has to do, ready for JSON."""
        return {**{k: v for k, v in asdict(self).items() if k not in ("name", "recipe")}, "recipe": self.recipe.model_dump()}


def scene_of(task: Mapping[str, Any]) -> Scene:
    """The scene that a ``Job.task`` learns from, with its modalities and frames alone.

    Raises:
        InputError: no such scene, modality or number of frames, or a copy of it that cannot be made.
    """
    scene = whole_scene_of(task, task["modalities"])
    if task["input"] == "demosaicked":
        copy = Path(task["prepared"]) / f"{scene.root.resolve().name}-{scene_hash(scene)[:12]}"
        scene = load_scene(write_demosaicked(scene, copy), modalities=task["modalities"], masks=scene.masks)
    return keep_frames(scene, task["frames"])


def whole_scene_of(task: Mapping[str, Any], modalities: Sequence[str] | None = None) -> Scene:
    """The scene as it was recorded, with all frames: what a task is scored on."""
    folder = task["mask_folder"]
    return load_scene(Path(task["scene"]), modalities=modalities, masks=task["masks"], mask_folder=None if folder is None else Path(folder))


def run_jobs(jobs: Sequence[Job], out: Path, progress: Progress | None = None) -> Iterator[dict[str, Any]]:
    """The result of every job in turn: read from ``out/rows`` where it is there, else made in a fresh process and written there.

    Args:
        progress: called with (jobs done, jobs in all).
    Returns:
        rows with ``name, identity, cores, threads, seed, device``, what ``worker.work`` measured, and ``mean``: each score averaged
        over the modalities that have it (PSNR in dB).
    Raises:
        InputError: a scene cannot be read (all are looked at before the first fit), a fit fails, or ``out`` cannot be written.
    """
    for job in jobs:
        scene_of(job.task())
    hashes = scene_hashes(jobs)
    counter = Counter(progress, len(jobs))
    counter(0)
    for job in jobs:
        # looked up when its turn comes: the code may have been edited since the bench began
        yield result_of(job, hashes[job.scene], out)
        counter(1)


def scene_hashes(jobs: Sequence[Job]) -> dict[str, str]:
    """``scene_hash`` of the whole scene of each job, by its path."""
    return {path: scene_hash(whole_scene_of(job.task())) for path, job in {job.scene: job for job in jobs}.items()}


def result_of(job: Job, scene: str, out: Path) -> dict[str, Any]:
    """The row of one job, see ``run_jobs``; ``scene``: its ``scene_hash``."""
    path, wanted = _file_of(job, scene, out)
    run = path.with_suffix("")
    if not path.is_file():
        machine = identify()
        about = {"name": job.name, "seed": job.seed, "device": job.device, "cores": machine["cores"], "threads": machine["threads"]}
        try:
            result = run_job(job, run)
        except DivergedError:
            shutil.rmtree(run, ignore_errors=True)  # from its checkpoint it would diverge again
            raise
        write_json(path, {**about, **result, "mean": mean_over_modalities(result["scores"]), "identity": wanted})
    shutil.rmtree(run, ignore_errors=True)
    return dict(read_json(path))


def finished_result_of(job: Job, scene: str, out: Path) -> dict[str, Any] | None:
    """The same where it is there already, else None."""
    path, _ = _file_of(job, scene, out)
    return read_json(path) if path.is_file() else None


def _file_of(job: Job, scene: str, out: Path) -> tuple[Path, dict[str, Any]]:
    """Where its row is or will be, and the identity that the name stands for."""
    wanted = identity(job, scene)
    return out / "rows" / f"{job.name}-{hashlib.sha256(json.dumps(wanted, sort_keys=True).encode()).hexdigest()[:12]}.json", wanted


def run_job(job: Job, run: Path) -> dict[str, Any]:
    """Fit and score in a fresh process (``mmsynth.bench.worker``).

    Args:
        run: folder of the fit, which goes on from the checkpoint that it has.
    Raises:
        InputError: the fit was refused or its process died.
        DivergedError: the fit diverged.
    """
    return in_a_process("mmsynth.bench.worker", {**job.task(), "run": str(run.resolve()), "began": time.time()}, job.name)


def in_a_process(module: str, task: Mapping[str, Any], name: str) -> dict[str, Any]:
    """What a module that ends in ``worker.serve`` makes of a task (ready for JSON), in a fresh process, which ends when this one does.

    Raises:
        InputError: the task was refused or its process died.
        DivergedError: its fit diverged.
    """
    with tempfile.TemporaryDirectory(prefix="mmsynth-bench-") as folder, open(Path(folder) / "stderr", "w+b") as said:
        command = [sys.executable, "-m", module, json.dumps(task), folder]
        path = os.pathsep.join([str(_PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {**os.environ, "PYTHONPATH": path}
        # nothing is ever written to its standard input: that it closes tells the child that nobody waits for the result. Ctrl-C is for
        # this process alone (a session of its own): a second signal would not let the child write its checkpoint
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said, env=environment, start_new_session=True
        ) as process:
            assert process.stdin is not None
            try:
                status = process.wait()
            except KeyboardInterrupt:
                process.stdin.close()
                process.wait()
                raise
        if status == 0:
            return read_json(Path(folder) / "result.json")
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
        for error in (InputError, DivergedError):
            if status == error.exit_code and lines[-1].startswith("error: "):
                raise error(lines[-1].removeprefix("error: "))
        raise InputError(f"{name}: its process ended with status {status} instead of a score ({lines[-1]}).")


def identity(job: Job, scene: str) -> dict[str, Any]:
    """Everything that a result depends on; ``scene``: the ``scene_hash`` of the whole scene."""
    machine = identify()
    task = {key: value for key, value in job.task().items() if key not in _PLACES}
    keys = () if job.any_machine else ("cpu", "cores", "threads", *(["gpu"] if job.device == "cuda" else []))
    return {
        "scene": scene,
        **task,
        **({} if job.prior is None else {"prior": _file_hash(Path(job.prior)).hex()[:16]}),
        "code": code_hash(),
        "versions": machine["versions"],
        "machine": {key: machine[key] for key in keys},
    }


def scene_hash(scene: Scene) -> str:
    """Of the frames, their poses, cameras and masks, the sensors, the region, the split and the ground truth."""
    digest = hashlib.sha256(
        repr((scene.region, scene.split, scene.unit, scene.black_background, scene.masks, list(scene.sensors.values()))).encode()
    )
    for frame in scene.frames:
        digest.update(repr((frame.sensor, frame.view, frame.camera)).encode())
        digest.update(np.ascontiguousarray(frame.camera_to_world).tobytes())
        for path in filter(None, (frame.path, frame.mask)):
            digest.update(_file_hash(path))
    for path in sorted((scene.root / "gt").rglob("*.npz")):
        digest.update(str(path.relative_to(scene.root)).encode() + _file_hash(path))
    return digest.hexdigest()[:16]


def code_hash() -> str:
    """Of the package's source that a fit and its score run through: at one version number it may have been edited."""
    digest = hashlib.sha256()
    for part in _CODE:
        path = _PACKAGE / part
        for source in sorted(path.rglob("*.py")) or [path]:
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def mean_over_modalities(scores: Mapping[str, Any]) -> dict[str, float]:
    """Every number that ``evaluate`` gives per modality, averaged over the modalities that have it."""
    modalities = scores["modalities"].values()
    keys = dict.fromkeys(key for m in modalities for key, value in m.items() if isinstance(value, float))
    return {key: float(np.mean([m[key] for m in modalities if key in m])) for key in keys}


def _file_hash(path: Path) -> bytes:
    try:
        return hashlib.sha256(path.read_bytes()).digest()
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror}).") from error
