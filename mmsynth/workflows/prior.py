"""A prior of several scenes: their fields, what these show, what it has in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from mmsynth.errors import InputError
from mmsynth.field.samples import sample_field
from mmsynth.fitting.run import fit
from mmsynth.packaged import data_folder
from mmsynth.prior.prior import Prior, learn_prior, load_prior, save_prior
from mmsynth.prior.responses import for_sensors, with_responses
from mmsynth.scene.exposure import stated_exposure
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene
from mmsynth.sensors.sensor_file import find_sensor_file, load_sensor
from mmsynth.workflows.runs import Run, is_run, open_run
from mmsynth.workflows.truth_samples import sample_truth


def make_prior(
    sources: Sequence[Path],
    out: Path,
    *,
    budget: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    truth: bool = False,
    sensors: Sequence[str] = (),
    say: Callable[[str], None] = lambda text: None,
) -> Prior:
    """Learn a prior from runs, and from scenes, which are fitted first, and write it.

    Args:
        sources: run folders or scenes, each with several modalities. budget, steps, device: of the fits of scenes, see ``fit``; their
            runs are
            in ``OUT's folder/prior_runs/SCENE`` and are taken again where they are finished. truth: do not fit scenes, take
            their ``gt/aligned`` and ``gt/geometry``: a second each, but nothing is known of gloss. sensors: files of captured sensors, or
            names of packaged ones, that say what the modalities' responses are. say: told one line a source.
    Raises:
        InputError: no sources, one that is neither run nor scene or has one modality, or the file cannot be written.
    """
    if not sources:
        raise InputError("prior: no scenes, expected runs or scenes with several modalities.")
    samples = []
    for source in sources:
        if truth and not is_run(source):
            samples.append(sample_truth(load_scene(source), seed=seed))
            say(f"{source}: {len(samples[-1].images):,} pixels of {', '.join(samples[-1].sensors)}")
            continue
        run = _run_of(source, out.parent / "prior_runs", budget, steps, seed, device, say)
        frames = run.scene.frames_of(run.field.measured[0], run.scene.split.train)
        samples.append(sample_field(run.field, frames, run.scene.root.resolve().name, stated_exposure(run.scene), seed=seed))
        say(f"{run.folder}: {len(samples[-1].images):,} rays of {', '.join(run.field.measured)}")
    prior = with_responses(learn_prior(samples, seed), [load_sensor(find_sensor_file(name)) for name in sensors])
    save_prior(prior, out)
    return prior


def _run_of(source: Path, folder: Path, budget: float | None, steps: int | None, seed: int, device: str, say: Callable[[str], None]) -> Run:
    if is_run(source):
        return open_run(source, device=device)
    scene = load_scene(source)
    if len(scene.sensors) < 2:
        raise InputError(f"{source}: one modality ({', '.join(scene.sensors)}), expected several: a prior learns one from the other.")
    run = folder / scene.root.resolve().name
    if is_run(run):
        return open_run(run, device=device)
    say(f"{source}: fitting it into {run}")
    return Run(run, fit(scene, run, budget=budget, steps=steps, seed=seed, device=device), scene)


def prior_file(name: str) -> Path:
    """Where a prior is that a user named: a file, or a packaged one."""
    packaged = data_folder("recipes") / "priors" / f"{name}.safetensors"
    return packaged if Path(name).suffix == "" and packaged.is_file() else Path(name)


def find_prior(name: str, scene: Scene | None = None, sensors: Sequence[str] = ()) -> Prior:
    """A prior by its file, or a packaged one by its name.

    Args:
        scene: for whose sensors; those of which there are ``sensors``, files of captured sensors, are expressed by the prior's channels.
    Raises:
        InputError: there is none, or it does not see the wavelengths of one of the scene's sensors.
    """
    prior = load_prior(prior_file(name))
    files = [load_sensor(find_sensor_file(file)) for file in sensors]
    return prior if scene is None or not files else for_sensors(prior, scene.sensors, files)
