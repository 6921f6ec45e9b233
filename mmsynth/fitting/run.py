"""A fit from a scene to a run folder: the loop, its log, its checkpoints and the manifest."""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mmsynth.errors import Interrupted, OutOfMemoryError, known_error
from mmsynth.field.field import Field
from mmsynth.field.kernels import Sampling
from mmsynth.field.samples import learn_from_frames, sample_field
from mmsynth.field.storage import save_field
from mmsynth.field.warmup import warm_up
from mmsynth.files import remove_leftovers, write_text
from mmsynth.fitting.checkpoint import CHECKPOINT_FOLDER, read_checkpoint, write_checkpoint
from mmsynth.fitting.choices import switch
from mmsynth.fitting.needs import Needs
from mmsynth.fitting.progress import FitProgress
from mmsynth.fitting.recipe import Recipe, load_recipe
from mmsynth.fitting.schedule import sampling_at
from mmsynth.fitting.signals import delayed_signals
from mmsynth.fitting.stored_frames import OnLoad
from mmsynth.fitting.trainer import Trainer
from mmsynth.fitting.unseen import solid_of, unmet_cells, unseen_before_cameras
from mmsynth.prior.prediction import common, predict, scene_facts
from mmsynth.prior.prior import Prior
from mmsynth.scene.exposure import Exposure, stated_exposure
from mmsynth.scene.scene import Scene, rig_of
from mmsynth.scene.serialisation import CONVENTIONS, source_to_json
from mmsynth.threads import usable_cores
from mmsynth.version import __version__

CHECKPOINT_EVERY = 60.0  # seconds
_BUDGET = 60.0  # seconds, of a fit that is given no length
_LOG_SECONDS = 1.0
_UNSEEN_ERROR = 1.5  # of a view that was not learned from, over that of those that were: 1.0 after a minute, 1.6 after five


def fit(
    scene: Scene,
    run: Path,
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
    on_field: Callable[[Field], None] | None = None,
) -> Field:
    """Learn the field of a scene and write it into a run folder.

    Args:
        recipe: or its name or file, see ``load_recipe``; None: the defaults.
        steps: length in optimiser steps, or ``budget``: length in seconds of training; when both are None, what a resumed
            checkpoint was planned for, else 60 s.
        device: cpu or cuda. resume: go on from the run's checkpoint, if it has one.
        prior: to predict modalities that the scene lacks. exposure: of the scene; None: what it states.
        checkpoint_every: seconds.
        on_load: called as frames are read, with how many were and how many there are.
        on_start: called once with what the scene was found to need. on_step: called after every step. on_field: called then with the field
            as it is, which it may render.
    Raises:
        InputError: the scene or recipe cannot be read, the run folder cannot be written, a checkpoint does not fit, or the prior has no
            channels in common with the scene.
        DivergedError: loss or gradients stopped to be finite; the checkpoint is kept.
        OutOfMemoryError: the fit can go on from the last checkpoint where there is more.
        Interrupted: by Ctrl-C or SIGTERM, after a checkpoint at the end of the step; a second one does not wait for it.
    """
    saved = read_checkpoint(run) if resume else None
    if steps is None and budget is None:
        planned = saved["task"] if saved else {}
        steps, budget = planned.get("steps") or None, planned.get("budget") or None
        if steps is None and budget is None:
            budget = _BUDGET
    exposure = stated_exposure(scene) if exposure is None else exposure
    if prior is not None:
        common(prior, scene.sensors)
    if device == "cpu":
        warm_up()
    recipe = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    taught = scene if prior is None else _without_sparse(scene, prior, recipe)
    trainer = Trainer(taught, recipe, steps, budget, seed, device, on_load)
    log: list[str] = []
    for folder in (run, run / CHECKPOINT_FOLDER):
        remove_leftovers(folder)
    if saved is not None:
        trainer.restore(saved)
        if (run / "train.jsonl").is_file():
            log = [x for x in (run / "train.jsonl").read_text().splitlines() if json.loads(x)["step"] <= trainer.state.step]
    else:
        # an empty checkpoint first: a run folder that cannot be written is known now and not after an hour
        write_checkpoint(run, trainer.checkpoint())
    if on_start is not None:
        on_start(trainer.needs)
    with _going_on_later(run), delayed_signals() as stop:
        _learn(trainer, run, log, checkpoint_every, stop, on_step, on_field)
        if stop:
            raise Interrupted(f"fit: stopped at step {trainer.state.step}; --resume goes on from there in {run}.", stop[0])
    field = _finished(trainer)
    field.manifest = _manifest(trainer, taught)
    if prior is not None:
        _predict(field, scene, prior, exposure)
    save_field(field, run)
    return field


def _learn(
    trainer: Trainer,
    run: Path,
    log: list[str],
    checkpoint_every: float,
    stop: Collection[int],
    on_step: Callable[[FitProgress], None] | None,
    on_field: Callable[[Field], None] | None,
) -> None:
    """Steps until the fit is done, or ``stop`` has a signal; the last checkpoint is where they end."""
    began, before = time.perf_counter(), trainer.state.elapsed
    last_saved = last_logged = began
    while trainer.progress < 1.0 and not stop:
        begins, made = time.perf_counter(), trainer.kernels_made
        trainer.run_step()
        now = time.perf_counter()
        if trainer.kernels_made > made:
            began += now - begins  # it was the compiler's, and would be missing from a budget
        trainer.state.elapsed = before + now - began
        if on_step is not None:
            on_step(trainer.report())
        if on_field is not None:
            trainer.field.sampling = _rendered_sampling(trainer)
            on_field(trainer.field)
        if now - last_logged > _LOG_SECONDS or trainer.progress >= 1.0:
            news = trainer.report()
            log.append(json.dumps({"step": news.step, "elapsed": round(news.elapsed, 3), "loss": news.loss, "psnr": news.psnr}))
            last_logged = now
        if now - last_saved > checkpoint_every and trainer.progress < 1.0:
            _save(run, trainer, log)
            last_saved = time.perf_counter()
    _save(run, trainer, log)


@contextmanager
def _going_on_later(run: Path) -> Iterator[None]:
    """What ends a fit in the middle says how to go on. The step may be half applied: the last checkpoint is what is safe."""
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt as error:
        raise Interrupted(f"fit: interrupted; --resume goes on from the last checkpoint in {run}.") from error
    except (MemoryError, RuntimeError) as error:
        known = known_error(error, "fit")
        if not isinstance(known, OutOfMemoryError):
            raise
        sentence = str(known).rstrip(".")
        raise OutOfMemoryError(f"{sentence}; --resume goes on from the last checkpoint in {run}.") from error


def _predict(field: Field, scene: Scene, prior: Prior, exposure: Exposure) -> None:
    """Let the field know what the prior says of modalities that the scene lacks or has few frames of, and the manifest, what that is."""
    began = time.perf_counter()
    frames = scene.frames_of(field.measured[0], scene.split.train)
    error = {name: _UNSEEN_ERROR * 10.0 ** (-psnr / 20.0) for name, psnr in field.manifest["train_psnr"].items()}
    prediction = predict(prior, scene_facts(prior, sample_field(field, frames, scene.root.name, exposure), error), field.measured)
    needs = field.manifest["needs"]["choices"]
    if not prediction.sensors:
        needs["prior"] = asdict(switch(False, f"the scene has all modalities that the prior of {len(prior.scenes)} scenes knows"))
        return
    taught = [name for name in prediction.sensors if name in scene.sensors]
    for name in taught:
        prediction = learn_from_frames(field, prediction, scene.sensors[name], scene.frames_of(name, scene.split.train))
        field.cameras[name] = scene.frames_of(name)[0].camera
    field.predict(replace(prediction, sensors=prediction.sensors | {name: scene.sensors[name] for name in taught}))
    field.rig = rig_of(scene) | field.rig if taught else field.rig
    facts, corrections = prediction.facts, prediction.corrections
    scenes = f"{len(prior.scenes)} scene{'s' * (len(prior.scenes) != 1)}"
    why = f"{', '.join(prediction.sensors)} predicted from {', '.join(facts.known)}, by {scenes}; the lamps' colour by {facts.how}"
    free = [name for name in facts.free if name not in taught]
    if free:
        why += f"; levels of {', '.join(free)} are what is usual, as no exposure is stated"
    for name, c in corrections.items():
        why += f"; {name}: error at its {c.frames} frame{'s' * (c.frames != 1)} {c.before:.3f} without them, {c.after:.3f} with them"
    needs["prior"] = asdict(switch(True, f"{why}; took {time.perf_counter() - began:.1f} s"))


def _without_sparse(scene: Scene, prior: Prior, recipe: Recipe) -> Scene:
    """The scene without modalities of so few frames that a prior knows more of them than a fit would."""
    counts = {name: sum(f.camera.width * f.camera.height for f in scene.frames_of(name, scene.split.train)) for name in scene.sensors}
    enough = recipe.sampling.sparse_below * max(counts.values())
    known = [name for name in common(prior, scene.sensors) if 0 < counts[name] < enough]
    sensors = {name: sensor for name, sensor in scene.sensors.items() if name not in known}
    return replace(scene, sensors=sensors, frames=tuple(f for f in scene.frames if f.sensor in sensors)) if known else scene


def _save(run: Path, trainer: Trainer, log: list[str]) -> None:
    # the log first: a fit that is killed in between drops the lines beyond its checkpoint, it could not make up for missing ones
    write_text(run / "train.jsonl", "".join(f"{line}\n" for line in log))
    write_checkpoint(run, trainer.checkpoint())


def _rendered_sampling(trainer: Trainer) -> Sampling:
    """How finely the field is rendered, as far as the fit is."""
    now = sampling_at(trainer.progress, trainer.recipe, trainer.needs)
    return now._replace(step=now.step * trainer.recipe.sampling.rendered_step_factor)


def _finished(trainer: Trainer) -> Field:
    """The field with the mean of its last parameters, the step of its renderings, nothing where nobody looked, and the corrected poses."""
    field = trainer.field
    trainer.average.apply()
    field.sampling = _rendered_sampling(trainer)
    surface, sharpness = field.surface.at(field.sampling.active_surface), field.sampling.sharpness
    field.occupancy.update(surface, sharpness)
    if field.design.background:
        unseen = unseen_before_cameras(trainer.measurements.values(), len(field.occupancy.states), solid_of(field))
        field.occupancy.empty(torch.from_numpy(unseen))
    elif trainer.has_opacity or trainer.needs.black_background:
        field.occupancy.empty(unmet_cells(field, trainer.measurements, np.random.default_rng((trainer.seed, 12))))
    field.corrections = trainer.refinement.corrections()
    field.rig = {n: pose @ field.corrections.sensors.get(n, np.eye(4)) for n, pose in field.rig.items()}
    return field


def _manifest(trainer: Trainer, scene: Scene) -> dict[str, Any]:
    news = trainer.report()
    return {
        "mmsynth": __version__,
        "scene": {
            **source_to_json(scene),
            "hash": trainer.task["scene"],
            "test_views": list(scene.split.test),
        },
        "recipe": trainer.recipe.model_dump(),
        "needs": asdict(replace(trainer.needs, choices=trainer.choices)),
        "exposure": trainer.gains(),
        "lamps": _lamps(trainer),
        "poses": _poses(trainer, scene),
        "seed": trainer.seed,
        "steps": trainer.state.step,
        "seconds": {"fit": news.elapsed},
        "rays_per_s": news.rays_per_s,
        "samples_per_s": news.samples_per_s,
        "train_psnr": news.psnr,
        "skipped_steps": trainer.state.bad_steps,
        "grid_reopened": trainer.state.reopened,
        "versions": {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__},
        "threads": torch.get_num_threads(),
        "cores": usable_cores(),
        "device": str(trainer.device),
        "conventions": CONVENTIONS,
    }


def _lamps(trainer: Trainer) -> list[dict[str, Any]]:
    """Of lamps that surfaces mirror: position in the scene's frame and unit, spectrum per modality, relative to full scale."""
    field = trainer.field
    if field.light is None or not field.shines:
        return []
    lamps = field.light.lamps()
    places = lamps.position.detach().cpu().numpy() * field.region.radius + np.array(field.region.centre)
    spectra = {n: lamps.spectrum[:, c].detach().cpu() * field.radiance_scale[n] for n, c in field.shader.columns.items()}
    of = lambda name, k: spectra[name][k, :1] if field.sensors[name].is_polarization else spectra[name][k]
    return [{"position": place.tolist(), "spectrum": {n: of(n, k).tolist() for n in spectra}} for k, place in enumerate(places)]


def _poses(trainer: Trainer, scene: Scene) -> dict[str, Any]:
    """Corrected poses and by how much: each training view that was moved, with its frames, and each sensor with its place on the rig."""
    field, sizes = trainer.field, trainer.refinement.sizes()
    frames = {n: scene.frames_of(n, scene.split.train) for n in field.sensors}
    return {
        "views": {
            v: size | {"camera_to_world": {n: field.pose_of(f).tolist() for n, fs in frames.items() for f in fs if str(f.view) == v}}
            for v, size in sizes["views"].items()
        },
        "sensors": {n: size | {"sensor_to_reference": field.rig[n].tolist()} for n, size in sizes["sensors"].items()},
    }
