"""Many scenes, one after the other: a fit and a dataset of each. One that fails does not stop the rest."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mmsynth.errors import InputError, OutOfMemoryError, known_error
from mmsynth.field.field import Field
from mmsynth.field.storage import load_field
from mmsynth.files import write_json
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import fit
from mmsynth.operations.dataset.generate import generate_dataset
from mmsynth.operations.dataset.plan import DatasetFormat
from mmsynth.operations.output.work_partition import WorkPartition, local_device
from mmsynth.operations.views.load import Rig
from mmsynth.report.dataset import write_dataset_report
from mmsynth.report.report import write_run_report
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import MaskMeaning, Scene


@dataclass(frozen=True)
class SceneJob:
    """What is made of each scene of a batch.

    Attributes:
        recipe: of the fits. steps, seconds: their length, one of the two or neither (the recipe's). modalities: names, None: all.
        poses: for ``generate_dataset``, None: no datasets; a file that is not there is sought in each scene's folder. rig, file_format: of
            the datasets.
    """

    recipe: Recipe
    steps: int | None = None
    seconds: float | None = None
    seed: int = 0
    device: str = "cpu"
    modalities: tuple[str, ...] | None = None
    masks: MaskMeaning | None = None
    mask_folder: Path | None = None
    poses: Path | None = None
    rig: Rig = "aligned"
    file_format: DatasetFormat = "npz"


def read_scene_list(path: Path) -> list[Path]:
    """Scene folders of a text file, one a line, # for comments; those that are not there as given are sought beside the file.

    Raises:
        InputError: unreadable, no scene in it, or two scenes whose folders have one name.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: could not be read ({error}).") from error
    named = [text for line in lines if (text := line.split("#")[0].strip())]
    if not named:
        raise InputError(f"{path}: no scene in it, expected one folder a line.")
    scenes = [Path(text) if Path(text).exists() else path.parent / text for text in named]
    names = [scene.resolve().name for scene in scenes]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{path}: two scenes are called '{name}', expected folders whose names differ: results go into OUT/{name}.")
    return scenes


def run_batch(
    scenes: Sequence[Path], out: Path, job: SceneJob, *, part: WorkPartition | None = None, say: Callable[[str], None] = lambda text: None
) -> dict[str, dict[str, Any]]:
    """Fit every scene and make its dataset, into ``<out>/NAME/run`` and ``<out>/NAME/dataset``; NAME/outcome.json says how it went.

    What is finished is not made again, what was cut off goes on. Under torchrun each process has its own scenes and, by LOCAL_RANK, its own
    GPU; a scene that is too large for one GPU is not split over several.

    Args:
        part: the scenes of this process, None: all. say: told a line per scene.
    Returns:
        by name, what outcome.json holds: "run", "dataset", "seconds", "train_psnr", or "error", the sentence of the scene that failed.
    """
    outcomes = {}
    for index in (part or WorkPartition()).of(len(scenes)):
        scene, name = scenes[index], scenes[index].resolve().name
        began = time.perf_counter()
        try:
            outcome = _fit_and_generate(scene, out / name, job)
            shown = ", ".join(f"{n} {v:.1f}" for n, v in outcome["train_psnr"].items())
            say(f"{name}: {shown} dB on training pixels, {time.perf_counter() - began:.0f} s")
        except Exception as error:  # one scene must not take the others down, whatever it is
            known = known_error(error, str(scene))
            outcome = {"error": f"{scene}: {type(error).__name__}: {error}" if known is None else str(known)}
            if isinstance(known, OutOfMemoryError) and "CUDA" in str(known):
                outcome = {"error": f"{scene}: does not fit into the memory of one GPU, and a scene is not split over several."}
        if "error" in outcome:
            say(f"{name}: failed: {outcome['error']}")
        outcomes[name] = {"scene": str(scene), "seconds": time.perf_counter() - began, **outcome}
        write_json(out / name / "outcome.json", outcomes[name])
    return outcomes


def _fit_and_generate(path: Path, out: Path, job: SceneJob) -> dict[str, Any]:
    scene = load_scene(path, modalities=job.modalities, masks=job.masks, mask_folder=job.mask_folder)
    run = out / "run"
    field = _fitted(scene, run, job)
    made = None
    if job.poses is not None:
        outputs = ["geometry", "flow"]
        made = generate_dataset(
            field, job.poses, out / "dataset", scene=scene, rig=job.rig, file_format=job.file_format, outputs=outputs
        ).path
        if made is not None:
            write_dataset_report(made.parent)
    return {"run": str(run), "dataset": None if made is None else str(made), "train_psnr": field.manifest["train_psnr"]}


def _fitted(scene: Scene, run: Path, job: SceneJob) -> Field:
    if (run / "manifest.json").is_file():
        return load_field(run, local_device(job.device))
    resume = (run / "checkpoint/state.pt").is_file()
    device = local_device(job.device)
    field = fit(scene, run, recipe=job.recipe, steps=job.steps, budget=job.seconds, seed=job.seed, device=device, resume=resume)
    write_run_report(run, field, scene=scene)
    return field
