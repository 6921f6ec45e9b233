"""``mmsynth bench NAME``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from mmsynth.cli.arguments import (
    DeviceOption,
    FramesOption,
    JsonOption,
    MasksOption,
    ModalitiesOption,
    RecipeOption,
    ResultsOption,
    RunOption,
    SceneArgument,
    fit_length,
    fractions,
    frame_limits,
    lengths,
    masks_of,
    modality_names,
    scene_path,
    seconds_of,
    whole_numbers,
)
from mmsynth.cli.terminal import app, command, progress_bar
from mmsynth.errors import InputError

bench_app = typer.Typer(no_args_is_help=True, help="Measure speed against error: a table, a plot and JSON, in bench/NAME or --out.")
app.add_typer(bench_app, name="bench")


@command("fit", of=bench_app)
def bench_fit(
    scene: SceneArgument,
    budgets: Annotated[str, typer.Option(help="training times, one fit from scratch for each")] = "15s,30s,60s,2m,5m,10m",
    recipe: RecipeOption = None,
    modalities: ModalitiesOption = None,
    frames: FramesOption = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    device: DeviceOption = "cpu",
    out: ResultsOption = Path("bench/fit"),
    as_json: JsonOption = False,
) -> None:
    """Error over time: a fit from scratch per time budget, each in a process of its own."""
    from mmsynth.bench.fit import bench_fit as measure
    from mmsynth.fitting.device import pick_device
    from mmsynth.fitting.recipe import load_recipe

    times = [seconds_of(text, "--budgets") for text in budgets.split(",")]
    with progress_bar("bench fit", as_json) as show:
        report = measure(
            scene_path(scene),
            times,
            out,
            load_recipe(recipe),
            modality_names(modalities),
            frame_limits(frames),
            seed,
            show,
            pick_device(device),
        )
    print_report(report, as_json)


@command("size", of=bench_app)
def bench_size(
    run: RunOption = None,
    scales: Annotated[str, typer.Option(help="shares of full size, 2464 pixels in a row")] = "1/8,1/4,1/2,1",
    views: Annotated[int | None, typer.Option(min=2, help="of the scene, so many; a tenth of them tests; default: all")] = None,
    budgets: Annotated[str, typer.Option(help="training times, one fit from scratch for each and each scale")] = "10m",
    scenes_only: Annotated[bool, typer.Option("--scenes-only", help="make the scenes in OUT/scenes, and fit nothing")] = False,
    recipe: RecipeOption = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    device: DeviceOption = "cpu",
    out: ResultsOption = Path("bench/size"),
    as_json: JsonOption = False,
) -> None:
    """The scene of a run as its field shows it to full-size sensors: error over time, start-up and memory by the size of frames."""
    from mmsynth.bench.size import bench_size as measure
    from mmsynth.bench.size import make_scenes
    from mmsynth.fitting.device import pick_device
    from mmsynth.fitting.recipe import load_recipe
    from mmsynth.workflows.runs import open_run

    times, wanted = [seconds_of(text, "--budgets") for text in budgets.split(",")], fractions(scales, "--scales")
    used, chosen = load_recipe(recipe), pick_device(device)
    opened = open_run(run, device=chosen)
    with progress_bar("scenes", as_json) as show:
        scenes = make_scenes(opened.field, opened.scene, wanted, out, views=views, progress=show)
    if scenes_only:
        made = {str(scale): str(path) for scale, path in scenes.items()}
        print(json.dumps({"scenes": made}) if as_json else "\n".join(f"scale {scale}: {path}" for scale, path in made.items()))
        return
    del opened  # the fits need the memory
    with progress_bar("bench size", as_json) as show:
        report = measure(scenes, times, out, used, seed, show, chosen)
    print_report(report, as_json)


@command("kernels", of=bench_app)
def bench_kernels(
    samples: Annotated[int, typer.Option(min=64, help="samples per call")] = 65536,
    threads: Annotated[int | None, typer.Option(min=1, help="default: those of torch and kernels")] = None,
    out: Annotated[Path, typer.Option()] = Path("bench/kernels"),
    as_json: JsonOption = False,
) -> None:
    """Every backend of every kernel: ns per sample, error against float64, share of the machine's bandwidth."""
    from mmsynth.bench.kernels import bench_kernels as measure

    with progress_bar("bench kernels", as_json) as show:
        report = measure(samples, out, threads, progress=show)
    print_report(report, as_json)


@command("gpu", of=bench_app)
def bench_gpu(out: Annotated[Path, typer.Option()] = Path("bench/gpu"), as_json: JsonOption = False) -> None:
    """What the GPU kernels take of a GPU, found without one: registers, spills and shared memory on sm_80, sm_90 and sm_100."""
    from mmsynth.bench.gpu import bench_gpu as measure

    print_report(measure(out), as_json)


@command("ablation", of=bench_app)
def bench_ablation(
    scene: SceneArgument,
    table: Annotated[str, typer.Option(help="engine, modalities, transfer, or a TOML file of variants")] = "engine",
    steps: Annotated[int | None, typer.Option(min=1, help="length of every fit in optimiser steps")] = None,
    budget: Annotated[str | None, typer.Option(help="or its time; default 60s")] = None,
    seeds: Annotated[str, typer.Option(help="every variant is fitted with each, e.g. 0,1,2")] = "0",
    only: Annotated[str | None, typer.Option(help="names of variants; the baseline is added")] = None,
    device: DeviceOption = "cpu",
    out: ResultsOption = Path("bench/ablation"),
    as_json: JsonOption = False,
) -> None:
    """What each choice is worth: variants of a fit against a baseline, in seconds and dB."""
    from mmsynth.bench.ablation import bench_ablation as measure
    from mmsynth.fitting.device import pick_device

    seconds = fit_length(steps, budget, "60s")
    chosen = None if only is None else [name.strip() for name in only.split(",")]
    with progress_bar("bench ablation", as_json) as show:
        report = measure(scene_path(scene), table, out, steps, seconds, whole_numbers(seeds, "--seeds"), chosen, show, pick_device(device))
    print_report(report, as_json)


@command("paper", of=bench_app)
def bench_paper(
    scenes: Annotated[list[str], typer.Argument(metavar="SCENE...", help="scene folders, or `example` for the packaged scene")],
    tables: Annotated[str | None, typer.Option(help="names of tables, or TOML files; default: all of recipes/paper")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="length of every fit in optimiser steps")] = None,
    budget: Annotated[str | None, typer.Option(help="or its time; default 60s")] = None,
    seeds: Annotated[str, typer.Option(help="everything is fitted with each, e.g. 0,1,2")] = "0",
    prior: Annotated[str | None, typer.Option(help="for rows with a prior: a file of `mmsynth prior`, or default", metavar="FILE")] = None,
    recipe: RecipeOption = None,
    masks: MasksOption = None,
    device: DeviceOption = "cpu",
    out: ResultsOption = Path("bench/paper"),
    as_json: JsonOption = False,
) -> None:
    """The tables of MultimodalStudio and SPOiLeR, on any scenes. Under torchrun every process takes its share of the fits."""
    from mmsynth.bench.paper import bench_paper as measure
    from mmsynth.fitting.device import pick_device
    from mmsynth.fitting.recipe import load_recipe
    from mmsynth.operations.output.work_partition import partition_of_environment
    from mmsynth.workflows.prior import find_prior, prior_file

    if prior is not None:
        find_prior(prior)  # that it cannot be read is known now and not after the first fits
    chosen = None if tables is None else [name.strip() for name in tables.split(",")]
    meaning, folder = masks_of(masks)
    with progress_bar("bench paper", as_json) as show:
        report = measure(
            [scene_path(scene) for scene in scenes],
            out,
            load_recipe(recipe),
            chosen,
            steps,
            fit_length(steps, budget, "60s"),
            whole_numbers(seeds, "--seeds"),
            meaning,
            folder,
            pick_device(device),
            partition_of_environment(),
            show,
            None if prior is None else prior_file(prior),
        )
    print_report(report, as_json)
    failed = report.results["failed"]
    if failed:
        raise InputError(f"paper: {len(failed)} fits failed, first: {next(iter(failed.values()))}")


@command("numerics", of=bench_app)
def bench_numerics(
    only: Annotated[str | None, typer.Option(help="undistortion, opacity, normals, angles, demosaicking, resampling; default: all")] = None,
    out: Annotated[Path, typer.Option()] = Path("bench/numerics"),
    as_json: JsonOption = False,
) -> None:
    """What is computed approximately: ns per element against error, ours beside the usual ways."""
    from mmsynth.bench.numerics import bench_numerics as measure

    with progress_bar("bench numerics", as_json) as show:
        report = measure(out, None if only is None else [name.strip() for name in only.split(",")], progress=show)
    print_report(report, as_json)


@command("twin", of=bench_app)
def bench_twin(
    only: Annotated[str | None, typer.Option(help="effects, optics, supersampling, calibration, spectra; default: all")] = None,
    run: Annotated[Path | None, typer.Option(help="a fitted field, whose supersampling is measured too")] = None,
    out: Annotated[Path, typer.Option()] = Path("bench/twin"),
    as_json: JsonOption = False,
) -> None:
    """The sensor's twin: ns per pixel of every effect against its closed form, supersampling, self-calibration, virtual channels."""
    from mmsynth.bench.twin import bench_twin as measure
    from mmsynth.workflows.runs import open_field

    field = None if run is None else open_field(run)[1]
    with progress_bar("bench twin", as_json) as show:
        report = measure(out, field, None if only is None else [name.strip() for name in only.split(",")], progress=show)
    print_report(report, as_json)


@command("render", of=bench_app)
def bench_render(
    run: RunOption = None,
    only: Annotated[str | None, typer.Option(help="termination, steps, asked, tiles, threads; default: all")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="default: those of torch and kernels")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="of each timing")] = 5,
    out: Annotated[Path, typer.Option()] = Path("bench/render"),
    as_json: JsonOption = False,
) -> None:
    """Rendering a fitted field: rays/s against error by early termination, sample budget, what is asked for, tiles and threads."""
    from mmsynth.bench.render import bench_render as measure
    from mmsynth.workflows.runs import open_run

    opened = open_run(run)
    with progress_bar("bench render", as_json) as show:
        report = measure(
            opened.field, opened.scene, out, None if only is None else [name.strip() for name in only.split(",")], threads, repeats, show
        )
    print_report(report, as_json)


@command("mesh", of=bench_app)
def bench_mesh(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="run folders, of several budgets for instance")],
    resolutions: Annotated[str, typer.Option(help="cells across the region of interest")] = "64,128,256,512",
    methods: Annotated[str | None, typer.Option(help="joined by ';': every block; mmsynth; mmsynth, closed; default: all")] = None,
    against: Annotated[Path | None, typer.Option(help="the true mesh, in the same frame and unit")] = None,
    distances: Annotated[str | None, typer.Option(help="of the F-score, e.g. 0.001,0.002")] = None,
    out: Annotated[Path, typer.Option()] = Path("bench/mesh"),
    as_json: JsonOption = False,
) -> None:
    """The surface as a mesh: resolution against time, memory and Chamfer distance, beside the usual extraction."""
    from mmsynth.bench.mesh import bench_mesh as measure

    cells = whole_numbers(resolutions, "--resolutions", "128,256")
    chosen = None if methods is None else [m.strip() for m in methods.split(";")]
    with progress_bar("bench mesh", as_json) as show:
        report = measure(runs, out, cells, chosen, against, lengths(distances), progress=show)
    print_report(report, as_json)


def print_report(report: Any, as_json: bool) -> None:
    from mmsynth.bench.tables import print_tables

    if as_json:
        print(json.dumps(report.results | {"out": str(report.out)}))
        return
    print_tables(report.tables)
    for note in report.results.get("notes", ()):
        print(f"note: {note}")
    if report.files:
        print(f"wrote {report.out}/ ({', '.join(report.files)})")
