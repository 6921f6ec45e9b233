"""Commands about scenes and fields: info, fit, evaluate, batch, doctor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from mmsynth.cli.arguments import (
    AlsoOption,
    DeviceOption,
    FramesOption,
    ImagesOption,
    JsonOption,
    LayoutOption,
    MasksOption,
    ModalitiesOption,
    RecipeOption,
    RunOption,
    SceneArgument,
    fit_length,
    frame_limits,
    masks_of,
    modality_names,
    modality_pairs,
    scene_path,
    seconds_of,
    sensor_folders,
)
from mmsynth.cli.looking import LiveView, PortOption
from mmsynth.cli.terminal import command, progress_bar
from mmsynth.errors import InputError

if TYPE_CHECKING:
    from mmsynth.operations.dataset.plan import DatasetFormat
    from mmsynth.operations.views.load import Rig


@command("info")
def info(
    scene: SceneArgument,
    layout: LayoutOption = None,
    images: ImagesOption = None,
    also: AlsoOption = None,
    masks: MasksOption = None,
    as_json: JsonOption = False,
) -> None:
    """What is in a scene: sensors, frames, mosaics, lens validity, problems."""
    from mmsynth.scene.info import describe_scene, render_text
    from mmsynth.scene.load import load_scene

    meaning, folder = masks_of(masks)
    read = load_scene(scene_path(scene), layout=layout, images=images, also=sensor_folders(also), masks=meaning, mask_folder=folder)
    description = describe_scene(read)
    print(json.dumps(description) if as_json else render_text(description))


@command("fit")
def fit(
    scene: SceneArgument,
    run: RunOption = None,
    recipe: RecipeOption = None,
    modalities: ModalitiesOption = None,
    frames: FramesOption = None,
    layout: LayoutOption = None,
    images: ImagesOption = None,
    also: AlsoOption = None,
    masks: MasksOption = None,
    budget: Annotated[str | None, typer.Option(help="training time, e.g. 60s, 5m; default 60s")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="length in optimiser steps instead")] = None,
    prior: Annotated[
        str | None, typer.Option(help="predict the modalities that the scene lacks: a file of `mmsynth prior`, or default", metavar="FILE")
    ] = None,
    exposure: Annotated[
        Path | None, typer.Option(help="gains or white boards of the modalities, for --prior; default: exposure.json in the scene")
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(help="file of one of the scene's sensors that --prior does not know, for its responses; once for each"),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on from the last checkpoint")] = False,
    checkpoint_every: Annotated[str, typer.Option(help="time that a fit which is killed loses at most, e.g. 10s, 5m")] = "60s",
    device: DeviceOption = "auto",
    seed: Annotated[int, typer.Option(min=0)] = 0,
    view: Annotated[bool, typer.Option("--view", help="show the field in the browser while it is learned")] = False,
    port: PortOption = 8080,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="every choice that was made for the scene, and why")] = False,
    as_json: JsonOption = False,
) -> None:
    """Learn the field of a scene."""
    from mmsynth.fitting.choices import Choice, choices_of, summary
    from mmsynth.fitting.device import pick_device
    from mmsynth.fitting.progress import FitProgress
    from mmsynth.report.text import fit_text
    from mmsynth.scene.exposure import read_exposure
    from mmsynth.scene.load import load_scene
    from mmsynth.scene.scene import keep_frames
    from mmsynth.workflows.fit import fit_run
    from mmsynth.workflows.prior import find_prior

    if view:
        from mmsynth.viewer.viewer import require_free

        require_free("127.0.0.1", port)
    seconds, every = fit_length(steps, budget), seconds_of(checkpoint_every, "--checkpoint-every")
    stated = None if exposure is None else read_exposure(exposure)
    meaning, folder = masks_of(masks)
    read = load_scene(
        scene_path(scene), modalities=modality_names(modalities), layout=layout, images=images, also=sensor_folders(also),
        masks=meaning, mask_folder=folder,
    )  # fmt: skip
    loaded = keep_frames(read, frame_limits(frames))
    of_scenes = None if prior is None else find_prior(prior, loaded, sensor or ())
    say = (lambda text: None) if as_json else print
    for problem in loaded.problems:
        say(f"note: {problem}")
    with progress_bar("fit", as_json) as show:

        def on_step(news: FitProgress) -> None:
            psnr = " ".join(f"{n} {v:.1f}" for n, v in news.psnr.items())
            show(news.done, 1.0, f"step {news.step}  loss {news.loss:.4f}  psnr {psnr} dB  {news.rays_per_s:,.0f} rays/s")

        def on_load(done: int, total: int) -> None:
            show(done, total, f"{done} of {total} frames read")

        told: set[str] = set()

        def explain(choices: dict[str, Choice[Any]]) -> None:
            for line in summary({name: choice for name, choice in choices.items() if name not in told}, verbose):
                say(line)
            told.update(choices)

        live = LiveView(loaded, port, say) if view else None
        fitted = fit_run(
            loaded, run, recipe=recipe, steps=steps, budget=seconds, seed=seed, device=pick_device(device), resume=resume,
            prior=of_scenes, exposure=stated, checkpoint_every=every, on_load=on_load,
            on_start=lambda needs: explain(needs.choices), on_step=on_step,
            on_field=live,
        )  # fmt: skip
        if live is not None:
            live.close()
        explain(choices_of(fitted.field.manifest))  # with what residuals decided on the way
    print(json.dumps(fitted.facts()) if as_json else fit_text(fitted.facts()))


@command("evaluate")
def evaluate(
    run: RunOption = None,
    masks: MasksOption = None,
    convert: Annotated[
        str | None, typer.Option(help="score conversions instead, e.g. rgb:ms or rgb:ms,mono:pol; all: every pair", metavar="FROM:TO")
    ] = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Score the test views."""
    from mmsynth.fitting.device import pick_device
    from mmsynth.operations.evaluation.conversions import evaluate_conversions
    from mmsynth.report.text import conversion_text, score_text
    from mmsynth.workflows.fit import evaluate_run
    from mmsynth.workflows.runs import open_run

    meaning, folder = masks_of(masks)
    opened = open_run(run, device=pick_device(device), masks=meaning, mask_folder=folder)
    with progress_bar("evaluate", as_json) as show:
        if convert is None:
            scores = evaluate_run(opened, progress=show)
            print(json.dumps(scores) if as_json else score_text(scores))
        else:
            pairs = modality_pairs(convert, opened.field.measured, list(opened.field.sensors))
            conversions = evaluate_conversions(opened.field, opened.scene, pairs, progress=show)
            print(json.dumps({"conversions": conversions}) if as_json else conversion_text(conversions))


@command("batch")
def batch(
    scenes: Annotated[Path, typer.Argument(help="text file, one scene folder a line")],
    poses: Annotated[Path | None, typer.Option(help="of a dataset of each, as for generate-dataset; none: only fits")] = None,
    recipe: RecipeOption = None,
    modalities: ModalitiesOption = None,
    masks: MasksOption = None,
    budget: Annotated[str | None, typer.Option(help="time of each fit, e.g. 60s or 5m")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="or its optimiser steps")] = None,
    rig: Annotated[str, typer.Option(help="aligned or native")] = "aligned",
    file_format: Annotated[str, typer.Option("--format", help="npz, exr, tiff, webdataset or mms-data")] = "npz",
    seed: Annotated[int, typer.Option(min=0)] = 0,
    device: DeviceOption = "auto",
    out: Annotated[Path, typer.Option(help="results of each scene go into OUT/NAME")] = Path("batch"),
    as_json: JsonOption = False,
) -> None:
    """Fit many scenes and make a dataset of each; one that fails does not stop the rest. Under torchrun every process takes its share."""
    from mmsynth.fitting.device import pick_device
    from mmsynth.fitting.recipe import load_recipe
    from mmsynth.operations.output.work_partition import partition_of_environment
    from mmsynth.workflows.batch import SceneJob, read_scene_list, run_batch

    seconds = fit_length(steps, budget)
    listed, part = read_scene_list(scenes), partition_of_environment()
    names = modality_names(modalities)
    meaning, folder = masks_of(masks)
    job = SceneJob(
        load_recipe(recipe), steps, seconds, seed, pick_device(device),
        modalities=None if names is None else tuple(names), masks=meaning, mask_folder=folder, poses=poses,
        rig=cast("Rig", rig), file_format=cast("DatasetFormat", file_format),
    )  # fmt: skip
    outcomes = run_batch(listed, out, job, part=part, say=(lambda text: None) if as_json else print)
    if as_json:
        print(json.dumps({"out": str(out), "scenes": outcomes}))
    failed = [name for name, outcome in outcomes.items() if "error" in outcome]
    if failed:
        raise InputError(f"batch: {len(failed)} of {len(outcomes)} scenes failed, first: {outcomes[failed[0]]['error']}")


@command("prior")
def prior(
    sources: Annotated[
        list[Path], typer.Argument(help="runs, or scenes, which are fitted first, each with several modalities", metavar="RUN|SCENE...")
    ],
    out: Annotated[Path, typer.Option(help="the file to write")] = Path("prior.safetensors"),
    budget: Annotated[str | None, typer.Option(help="time of the fit of each scene, e.g. 60s, 5m; default 60s")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="or its optimiser steps")] = None,
    truth: Annotated[bool, typer.Option("--truth", help="do not fit scenes: take the aligned truth in their gt folders")] = False,
    sensor: Annotated[
        list[str] | None,
        typer.Option(help="file of one of the sensors, for its responses: other rigs can use the prior then; once for each"),
    ] = None,
    device: DeviceOption = "auto",
    seed: Annotated[int, typer.Option(min=0)] = 0,
    as_json: JsonOption = False,
) -> None:
    """Learn what scenes have in common, so that `fit --prior` can predict modalities that a scene lacks."""
    from mmsynth.fitting.device import pick_device
    from mmsynth.report.text import prior_text
    from mmsynth.workflows.prior import make_prior

    seconds = fit_length(steps, budget)
    made = make_prior(
        sources,
        out,
        budget=seconds,
        steps=steps,
        seed=seed,
        device=pick_device(device),
        truth=truth,
        sensors=sensor or (),
        say=(lambda text: None) if as_json else print,
    )
    if as_json:
        print(json.dumps({"prior": str(out), "scenes": list(made.scenes), "modalities": list(made.sensors)}))
    else:
        print(prior_text(made, out))


@command("doctor")
def doctor(as_json: JsonOption = False) -> None:
    """Print versions, threads, GPU, state of the compiled kernels, and advice."""
    from mmsynth.bench.doctor import diagnose, render_text

    facts = diagnose()
    print(json.dumps(facts) if as_json else render_text(facts))
