"""The command line: each command parses, calls one public function, and prints."""

from __future__ import annotations

import functools
import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from mmsynth.errors import InputError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Learn one radiance field of a scene from several sensors; then convert, generate, mesh.",
)
bench_app = typer.Typer(no_args_is_help=True, help="Measure speed against error: a table, a plot and JSON, in bench/NAME or --out.")
app.add_typer(bench_app, name="bench")
RunOption = Annotated[Path | None, typer.Option("--run", help="run folder; default: the last fit made in this folder")]
DeviceOption = Annotated[str, typer.Option(help="auto, cpu or cuda")]
JsonOption = Annotated[bool, typer.Option("--json", help="print one JSON object on stdout and nothing else there")]
SceneArgument = Annotated[str, typer.Argument(metavar="SCENE", help="scene folder, or `example` for the packaged scene")]
RecipeOption = Annotated[str | None, typer.Option(help="packaged recipe or TOML file")]
ModalitiesOption = Annotated[str | None, typer.Option(help="fit these only, e.g. rgb,ms")]
FramesOption = Annotated[str | None, typer.Option(help="training frames to keep of some modalities, e.g. pol=3,ms=5; default: all")]


def command(name: str, of: typer.Typer = app) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a command whose ``InputError`` becomes one sentence on stderr and exit code 2."""

    def register(function: Callable[..., None]) -> Callable[..., None]:
        @of.command(name)
        @functools.wraps(function)
        def guarded(*args: Any, **kwargs: Any) -> None:
            try:
                function(*args, **kwargs)
            except InputError as error:
                print(f"error: {error}", file=sys.stderr)
                raise typer.Exit(2) from None
            except KeyboardInterrupt:
                print("interrupted", file=sys.stderr)
                raise typer.Exit(130) from None

        return guarded

    return register


def _names(text: str | None) -> list[str] | None:
    from mmsynth.scene.scene import canonical_modality

    return None if text is None else [canonical_modality(n) for n in text.split(",") if n.strip()]


def _views(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    if not re.fullmatch(r"\d+(,\d+)*", text):
        raise InputError(f"--views {text!r}: expected view ids such as 9,19.")
    return tuple(int(v) for v in text.split(","))


def _poses_file(path: Path, folder: Path) -> Path:
    """As given, else in the scene's folder."""
    within = folder / path
    return within if not path.exists() and within.exists() else path


def _frames(text: str | None) -> dict[str, int]:
    from mmsynth.scene.scene import canonical_modality

    limits: dict[str, int] = {}
    for part in text.split(",") if text is not None else ():
        match = re.fullmatch(r"\s*([^=\s]+)\s*=\s*(\d+)\s*", part)
        name = canonical_modality(match[1]) if match else ""
        if not match or name in limits:
            raise InputError(f"--frames {text!r}: expected a number of frames per modality, each once, such as pol=3,ms=5.")
        limits[name] = int(match[2])
    return limits


def _pairs(text: str, known: list[str]) -> list[tuple[str, str]]:
    from mmsynth.scene.scene import canonical_modality

    if text == "all":
        return [(a, b) for a in known for b in known if a != b]
    if not re.fullmatch(r"[^:,\s]+:[^:,\s]+(,[^:,\s]+:[^:,\s]+)*", text):
        raise InputError(f"--convert {text!r}: expected pairs such as rgb:ms or rgb:ms,mono:pol, or all.")
    pairs = [part.split(":") for part in text.split(",")]
    return [(canonical_modality(a), canonical_modality(b)) for a, b in pairs]


def _seeds(text: str) -> list[int]:
    if not re.fullmatch(r"\d+(,\d+)*", text):
        raise InputError(f"--seeds {text!r}: expected numbers such as 0,1.")
    return [int(seed) for seed in text.split(",")]


def _lengths(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or not all(0 < x < float("inf") for x in found):
        raise InputError(f"--distances {text!r}: expected lengths above 0 such as 0.001,0.002.")
    return found


def _seconds(text: str, option: str = "--budget") -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|m|h)?", text.strip())
    if not match or float(match[1]) <= 0:
        raise InputError(f"{option} {text!r}: expected a time such as 60s, 5m or 1h.")
    return float(match[1]) * {"s": 1, "m": 60, "h": 3600}[match[2] or "s"]


def _length(steps: int | None, budget: str | None, default: str | None = None) -> float | None:
    """Seconds of a fit whose length is not given in steps."""
    if steps is not None and budget is not None:
        raise InputError("--steps and --budget: give one of the two.")
    text = budget or default
    return _seconds(text) if text and steps is None else None


def _scene_path(text: str) -> Path:
    from mmsynth.packaged import data_folder

    path = Path(text)
    return data_folder("example_scene") if text == "example" and not path.exists() else path


@contextmanager
def _bar(title: str, quiet: bool) -> Iterator[Callable[..., None]]:
    """A progress bar on stderr, for terminals: the yielded function is called with (done, total) and, if any, news to show."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(24),
        TextColumn("{task.percentage:3.0f}%"),
        TimeElapsedColumn(),
        TextColumn("eta"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[news]}"),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, refresh_per_second=4) as progress:
        task = progress.add_task(title, total=None, news="")
        yield lambda done, total, news="": progress.update(task, completed=done, total=total, news=news)


def _load_field(run: Path | None, device: str = "cpu") -> tuple[Path, Any]:
    """Run folder and its field."""
    from mmsynth.field.field import Field
    from mmsynth.fitting.run_folders import chosen_run

    path = chosen_run(run)
    return path, Field.load(path, device)


def _load(run: Path | None, device: str = "cpu") -> tuple[Path, Any, Any]:
    """Run folder, field, and the scene it was fitted to."""
    from mmsynth.scene.load import load_scene

    path, field = _load_field(run, device)
    return path, field, load_scene(Path(field.manifest["scene"]["path"]), list(field.sensors))


@command("info")
def info(scene: SceneArgument, as_json: JsonOption = False) -> None:
    """What is in a scene: sensors, frames, mosaics, lens validity, problems."""
    from mmsynth.scene.info import describe, render_text
    from mmsynth.scene.load import load_scene

    description = describe(load_scene(_scene_path(scene)))
    print(json.dumps(description) if as_json else render_text(description))


@command("fit")
def fit(
    scene: SceneArgument,
    run: RunOption = None,
    recipe: RecipeOption = None,
    modalities: ModalitiesOption = None,
    frames: FramesOption = None,
    budget: Annotated[str | None, typer.Option(help="training time, e.g. 60s, 5m; default 60s")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="length in optimiser steps instead")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="go on from the last checkpoint")] = False,
    device: DeviceOption = "auto",
    seed: Annotated[int, typer.Option(min=0)] = 0,
    as_json: JsonOption = False,
) -> None:
    """Learn the field of a scene."""
    from mmsynth.fitting.needs import Needs
    from mmsynth.fitting.recipe import load_recipe
    from mmsynth.fitting.run_folders import mark_latest, new_run, run_to_resume
    from mmsynth.fitting.trainer import Progress, pick_device
    from mmsynth.fitting.trainer import fit as fit_field
    from mmsynth.report.report import write_run_report
    from mmsynth.scene.load import load_scene
    from mmsynth.scene.scene import keep_frames

    seconds = _length(steps, budget)
    loaded = keep_frames(load_scene(_scene_path(scene), _names(modalities)), _frames(frames))
    name = loaded.root.resolve().name
    folder = run or (run_to_resume(name) if resume else new_run(name))

    def say(text: str) -> None:
        if not as_json:
            print(text)

    for problem in loaded.problems:
        say(f"note: {problem}")
    with _bar("fit", as_json) as show:

        def on_step(news: Progress) -> None:
            psnr = " ".join(f"{n} {v:.1f}" for n, v in news.psnr.items())
            show(news.done, 1.0, f"step {news.step}  loss {news.loss:.4f}  psnr {psnr} dB  {news.rays_per_s:,.0f} rays/s")

        told: set[str] = set()

        def explain(evidence: dict[str, str]) -> None:
            for what, why in evidence.items():
                if what not in told:
                    say(f"needs {what}: {why}")
            told.update(evidence)

        def on_start(needs: Needs) -> None:
            explain(needs.evidence)

        field = fit_field(
            loaded, folder, load_recipe(recipe), steps, seconds, seed, pick_device(device), resume, on_start=on_start, on_step=on_step
        )
        explain(field.manifest["needs"]["evidence"])  # with what residuals decided on the way
    write_run_report(folder, field, scene=loaded)
    mark_latest(folder)
    facts = {"run": str(folder), **{k: field.manifest[k] for k in ("steps", "seconds", "train_psnr", "rays_per_s", "samples_per_s")}}
    if as_json:
        print(json.dumps(facts))
        return
    shown = ", ".join(f"{n} {v:.1f}" for n, v in facts["train_psnr"].items())
    print(f"{facts['steps']} steps in {facts['seconds']['fit']:.0f} s, {facts['rays_per_s']:,.0f} rays/s")
    print(f"PSNR on training pixels [dB]: {shown}")
    print(f"wrote {folder}/ (field.safetensors, manifest.json, preview.png, report.html)")


@command("evaluate")
def evaluate(
    run: RunOption = None,
    convert: Annotated[
        str | None, typer.Option(help="score conversions instead, e.g. rgb:ms or rgb:ms,mono:pol; all: every pair", metavar="FROM:TO")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Score the test views."""
    from mmsynth.operations.evaluation.evaluate import evaluate as score
    from mmsynth.report.report import write_run_report
    from mmsynth.report.text import conversion_text, score_text

    folder, field, scene = _load(run)
    if convert is not None:
        from mmsynth.operations.evaluation.conversions import evaluate_conversion

        pairs = _pairs(convert, list(field.sensors))
        found = []
        with _bar("evaluate", as_json) as show:
            for done, (a, b) in enumerate(pairs):
                found.append(evaluate_conversion(field, scene, a, b))
                show(done + 1, len(pairs))
        print(json.dumps({"conversions": found}) if as_json else conversion_text(found))
        return
    with _bar("evaluate", as_json) as show:
        scores = score(field, scene, progress=show)
    write_run_report(folder, field, scores, scene=scene)
    print(json.dumps(scores) if as_json else score_text(scores))


@command("convert")
def convert(
    source: Annotated[str, typer.Option("--from", help="modality whose frames give pose and pixel grid")],
    target: Annotated[str, typer.Option("--to", help="modality to synthesise")],
    run: RunOption = None,
    views: Annotated[str | None, typer.Option(help="view ids, e.g. 9,19; default: all frames of the source")] = None,
    method: Annotated[str, typer.Option(help="auto, field, ratio or guided")] = "auto",
    images: Annotated[
        list[Path] | None, typer.Option(help="frames of the source, once per file: found by what they show, or at --poses by their names")
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="poses of the source, as for generate-dataset; without --images the field alone is rendered")
    ] = None,
    as_sensor: Annotated[
        bool, typer.Option("--as-sensor", help="from the target's own place, through its lens; else on the source's pixels")
    ] = False,
    file_format: Annotated[str, typer.Option("--format", help="npz, exr or tiff")] = "npz",
    out: Annotated[Path | None, typer.Option(help="default: RUN/convert/FROM_to_TO")] = None,
    as_json: JsonOption = False,
) -> None:
    """Another modality at the poses of the frames of one, or at any poses."""
    from mmsynth.operations.conversion.files import convert_at_poses, convert_frames, convert_images
    from mmsynth.operations.views.trajectories import load_views
    from mmsynth.scene.scene import canonical_modality

    folder, field, scene = _load(run)
    a, b = canonical_modality(source), canonical_modality(target)
    if views is not None and (images or poses):
        raise InputError("--views: frames of the scene are converted with it, expected it without --images and --poses.")
    chosen = _views(views)
    destination = out or folder / "convert" / f"{a}_to_{b}"
    with _bar(f"{a} to {b}", as_json) as show:
        if poses is not None:
            at = load_views(_poses_file(poses, scene.root), field, scene, a)
            written = convert_at_poses(field, scene, a, b, at, destination, images or [], method, as_sensor, file_format, show)
        elif images:
            written = convert_images(field, scene, a, b, images, destination, method, as_sensor, file_format, show)
        else:
            written = convert_frames(field, scene, a, b, destination, chosen, method, as_sensor, file_format, show)
    _tell(destination, written, as_json)


@command("generate-dataset")
def generate_dataset(
    poses: Annotated[
        Path,
        typer.Option(
            help="transforms.json, camera_path.json, images.txt, meta_data.json, TUM or a trajectory; sought here, then in the scene"
        ),
    ] = Path("poses.json"),
    run: RunOption = None,
    rig: Annotated[
        str, typer.Option(help="aligned: all modalities on one camera; native: each sensor at its place on the rig")
    ] = "aligned",
    modalities: Annotated[str | None, typer.Option(help="default: all")] = None,
    outputs: Annotated[
        str | None, typer.Option(help="beside the modalities: some of geometry,flow,coverage, or none; default: all", metavar="NAMES")
    ] = None,
    min_coverage: Annotated[
        float | None, typer.Option(help="leave out views that the training frames cover less; 1 = their own pixels")
    ] = None,
    sensor: Annotated[
        list[str] | None, typer.Option(help="also raw frames of this sensor file or packaged sensor, once per sensor; into OUT/raw")
    ] = None,
    raw: Annotated[
        bool, typer.Option("--raw", help="also raw frames of the field's own sensors, as calibrate-noise found them (RUN/sensors)")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="of the raw frames' noise")] = 0,
    out: Annotated[Path | None, typer.Option(help="default: RUN/dataset")] = None,
    file_format: Annotated[str, typer.Option("--format", help="npz, exr, tiff, webdataset or mms-data")] = "npz",
    device: DeviceOption = "auto",
    verify: Annotated[bool, typer.Option("--verify", help="only check a finished dataset against its checksums")] = False,
    as_json: JsonOption = False,
) -> None:
    """An aligned dataset: every modality, depth, normals, opacity, coverage, flow, intrinsics and pose per view. Under torchrun every
    process makes its share."""
    from mmsynth.fitting.trainer import pick_device
    from mmsynth.operations.dataset import generate as dataset
    from mmsynth.operations.dataset import index as dataset_index
    from mmsynth.operations.output.work_partition import local_device, share_of_environment
    from mmsynth.operations.views.coverage import covered_views, training_rays, view_scores
    from mmsynth.operations.views.trajectories import load_views

    if min_coverage is not None and not 0.0 <= min_coverage <= 1.0:
        raise InputError(f"--min-coverage {min_coverage:g}: expected a number from 0 to 1.")
    share = share_of_environment()
    folder, field, scene = _load(run, local_device(pick_device(device)))
    destination = out or folder / "dataset"
    if verify:
        problems = dataset_index.verify(destination)
        if problems:
            raise InputError(f"{destination}: {len(problems)} problems, first: {problems[0]}")
        print(json.dumps({"out": str(destination), "problems": []}) if as_json else f"{destination}: complete, every checksum matches")
        return
    views = load_views(_poses_file(poses, scene.root), field, scene)
    names = _names(modalities)
    wanted = None if outputs is None else [] if outputs == "none" else [name.strip() for name in outputs.split(",")]
    sensors = [*(sensor or ()), *(folder / "sensors" / f"{name}.toml" for name in (names or field.sensors) if raw)]
    rays = None
    if min_coverage is not None or wanted is None or "coverage" in wanted:
        with _bar("training rays", as_json) as show:
            rays = training_rays(field, scene, progress=show)
    left_out: list[tuple[str, float]] = []
    if min_coverage is not None:
        given = len(views)
        assert rays is not None
        with _bar("coverage", as_json) as show:
            scores = view_scores(field, rays, views, progress=show)
        views, left_out = covered_views(views, scores, min_coverage)
        if left_out and not as_json:
            named = ", ".join(f"{name} ({score:.2f})" for name, score in left_out)
            print(f"left out {len(left_out)} of {given} views with a coverage below {min_coverage:g}: {named}")
    with _bar("dataset", as_json) as show:
        written = dataset.generate_dataset(
            field, views, destination, names, rig, file_format, wanted, rays, sensors, seed, share, progress=show
        )
    unseen = [{"name": name, "coverage_score": score} for name, score in left_out]
    facts = {"dataset": None if written is None else str(written), "views": len(views), "left_out": unseen}
    if as_json:
        print(json.dumps(facts))
    elif written is None:
        print(f"process {share.number} of {share.processes}: its share of {len(views)} views is in {destination}/, others are at work")
    else:
        print(f"wrote {len(views)} views into {destination}/")


@command("batch")
def batch(
    scenes: Annotated[Path, typer.Argument(help="text file, one scene folder a line")],
    poses: Annotated[Path | None, typer.Option(help="of a dataset of each, as for generate-dataset; none: only fits")] = None,
    recipe: RecipeOption = None,
    modalities: ModalitiesOption = None,
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
    from mmsynth.fitting.recipe import load_recipe
    from mmsynth.fitting.trainer import pick_device
    from mmsynth.operations.output.work_partition import share_of_environment
    from mmsynth.workflows.batch import Job, read_scene_list, run_batch

    seconds = _length(steps, budget)
    listed, share = read_scene_list(scenes), share_of_environment()
    names = _names(modalities)
    job = Job(
        load_recipe(recipe), steps, seconds, seed, pick_device(device), None if names is None else tuple(names), poses, rig, file_format
    )
    outcomes = run_batch(listed, out, job, share, say=(lambda text: None) if as_json else print)
    if as_json:
        print(json.dumps({"out": str(out), "scenes": outcomes}))
    failed = [name for name, outcome in outcomes.items() if "error" in outcome]
    if failed:
        raise InputError(f"batch: {len(failed)} of {len(outcomes)} scenes failed, first: {outcomes[failed[0]]['error']}")


@command("simulate")
def simulate(
    sensor: Annotated[list[str], typer.Option(help="sensor file, or the name of a packaged one; once per sensor of the rig")],
    poses: Annotated[Path | None, typer.Option(help="of the rig's reference: as for generate-dataset")] = None,
    views: Annotated[str | None, typer.Option(help="instead: at frames of the scene, train, test, all or ids, e.g. 9,19")] = None,
    run: RunOption = None,
    rig: Annotated[str, typer.Option(help="native: each sensor at its place on the rig; aligned: all at the poses")] = "native",
    delta: Annotated[
        bool, typer.Option("--delta", help="of captured sensors: apply the file's effects on top of what the field has")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="of noise and fixed patterns")] = 0,
    file_format: Annotated[str, typer.Option("--format", help="png, tiff or dng")] = "png",
    out: Annotated[Path | None, typer.Option(help="default: RUN/simulated")] = None,
    as_json: JsonOption = False,
) -> None:
    """The sensor's digital twin: raw frames as it would have recorded them, a scene that can be fitted again."""
    from mmsynth.operations.output.work_partition import share_of_environment
    from mmsynth.operations.simulation import simulate as twins
    from mmsynth.operations.views.trajectories import load_views

    if (poses is None) == (views is None):
        raise InputError("simulate: give one of --poses and --views.")
    share = share_of_environment()
    folder, field, scene = _load(run)
    destination = out or folder / "simulated"
    with _bar("simulate", as_json) as show:
        if poses is not None:
            at = load_views(_poses_file(poses, scene.root), field, scene)
            written = twins.simulate(field, sensor, at, destination, seed, file_format, rig, delta, share, show)
        else:
            if rig != "native":
                raise InputError("--rig: frames of the scene have their sensors' own poses, expected it with --poses.")
            split = {"train": scene.split.train, "test": scene.split.test, "all": None}
            chosen = split[views] if views in split else _views(views)
            written = twins.simulate_at_frames(field, scene, sensor, destination, chosen, seed, file_format, delta, share, show)
    if as_json:
        print(json.dumps({"scene": str(destination)}))
        return
    if written is None:
        print(f"process {share.number} of {share.processes}: its share of the frames is in {destination}/, others are at work")
        return
    for line in twins.foretold(written.parent):
        print(line)
    print(f"wrote {written.parent}/ ({written.name}, modalities, sidecars, sensors)")


@command("calibrate-noise")
def calibrate_noise(
    frames: Annotated[
        list[Path] | None, typer.Argument(metavar="[FRAME]...", help="raw files of the one --sensor: no field needed")
    ] = None,
    run: RunOption = None,
    modalities: Annotated[str | None, typer.Option(help="default: all")] = None,
    sensor: Annotated[
        list[str] | None, typer.Option(help="sensor files that say bits, black level and alignment; default: what the frames use")
    ] = None,
    raw: Annotated[Path | None, typer.Option(help="other frames at the same poses, of any exposure: RAW/MODALITY/0009.png")] = None,
    views: Annotated[str | None, typer.Option(help="view ids, e.g. 9,19; default: those of the training")] = None,
    out: Annotated[Path | None, typer.Option(help="default: RUN/sensors, or sensors")] = None,
    as_json: JsonOption = False,
) -> None:
    """Gain, read noise and PRNU from photon transfer, into sensor files; from a scene's frames and its field, or from frames alone."""
    from mmsynth.operations.simulation import calibrate_noise as noise
    from mmsynth.report.text import noise_text
    from mmsynth.sensors.sensor_file import find_sensor_file, load_sensor

    files = [load_sensor(find_sensor_file(name)) for name in sensor or []]
    untold: dict[str, str] = {}
    if frames:
        if len(files) != 1:
            raise InputError(f"calibrate-noise: {len(files)} sensor files for these frames, expected one --sensor that describes them.")
        found, destination = {files[0].name: noise.calibrate_from_frames(files[0], frames)}, out or Path("sensors")
    else:
        folder, field, scene = _load(run)
        known = noise.by_modality(files)
        with _bar("noise", as_json) as show:
            found, untold = noise.calibrate_noise(field, scene, _names(modalities), known, raw, _views(views), progress=show)
        destination = out or folder / "sensors"
    if found:
        noise.write(found, destination)
        facts = {"out": str(destination), "sensors": {n: c.to_json() for n, c in found.items()}}
        print(json.dumps(facts) if as_json else noise_text(found))
        if not as_json:
            print(f"wrote {destination}/ ({', '.join(f'{n}.toml' for n in found)}, noise.svg)")
    if untold:
        raise InputError(" ".join(untold.values()))


@command("mesh")
def mesh(
    run: RunOption = None,
    resolution: Annotated[int, typer.Option(min=8, max=8192, help="cells across the region of interest")] = 256,
    out: Annotated[Path | None, typer.Option(help="PLY, GLB, OBJ or STL; default: RUN/mesh.ply")] = None,
    closed: Annotated[bool, typer.Option("--closed", help="close the surface where the region's border cuts it")] = False,
    keep: Annotated[str, typer.Option(help="components: clean (no specks), all, largest, or how many")] = "clean",
    min_views: Annotated[int, typer.Option(min=0, help="keep components only that so many training views see")] = 0,
    faces: Annotated[int | None, typer.Option(min=4, help="decimate to so many")] = None,
    max_error: Annotated[float | None, typer.Option(help="or as far as 99.9 % of it stays that near [unit]")] = None,
    geometry_only: Annotated[bool, typer.Option("--geometry-only", help="no colours and no modalities on the vertices")] = False,
    against: Annotated[Path | None, typer.Option(help="score it against this mesh, in the same frame and unit")] = None,
    distances: Annotated[str | None, typer.Option(help="of the F-score, e.g. 0.001,0.002; default: 0.5, 1 and 2 % of the radius")] = None,
    as_json: JsonOption = False,
) -> None:
    """The surface with every modality on it, in the input's frame and unit."""
    from mmsynth.operations.mesh.extract import MeshOptions, keep_of, mesh_to_file
    from mmsynth.report.text import mesh_text

    if geometry_only and not min_views and against is None:
        (folder, field), scene = _load_field(run), None  # the scene may be elsewhere
    else:
        folder, field, scene = _load(run)
    destination, at = out or folder / "mesh.ply", _lengths(distances)
    options = MeshOptions(
        resolution, keep=keep_of(keep), closed=closed, attributes=not geometry_only, min_views=min_views, faces=faces, max_error=max_error
    )
    with _bar("mesh", as_json) as show:
        report = mesh_to_file(field, destination, options, scene=scene, against=against, distances=at, progress=show)
    print(json.dumps(report) if as_json else mesh_text(report))


@command("doctor")
def doctor(as_json: JsonOption = False) -> None:
    """Versions, threads, GPU, kernels, and what to do."""
    from mmsynth.bench.doctor import diagnose, render_text

    facts = diagnose()
    print(json.dumps(facts) if as_json else render_text(facts))


@command("fit", of=bench_app)
def bench_fit(
    scene: SceneArgument,
    budgets: Annotated[str, typer.Option(help="training times, one fit from scratch for each")] = "15s,30s,60s,2m,5m,10m",
    recipe: RecipeOption = None,
    modalities: ModalitiesOption = None,
    frames: FramesOption = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    device: DeviceOption = "cpu",
    out: Annotated[Path, typer.Option(help="what is there already is not fitted again")] = Path("bench/fit"),
    as_json: JsonOption = False,
) -> None:
    """Error over time: a fit from scratch per time budget, each in a process of its own."""
    from mmsynth.bench.fit import bench_fit as measure
    from mmsynth.fitting.recipe import load_recipe
    from mmsynth.fitting.trainer import pick_device

    times = [_seconds(text, "--budgets") for text in budgets.split(",")]
    with _bar("bench fit", as_json) as show:
        report = measure(
            _scene_path(scene), times, out, load_recipe(recipe), _names(modalities), _frames(frames), seed, show, pick_device(device)
        )
    _print_report(report, as_json)


@command("kernels", of=bench_app)
def bench_kernels(
    samples: Annotated[int, typer.Option(min=64, help="samples per call")] = 65536,
    threads: Annotated[int | None, typer.Option(min=1, help="default: those of torch and numba")] = None,
    out: Annotated[Path, typer.Option()] = Path("bench/kernels"),
    as_json: JsonOption = False,
) -> None:
    """Every backend of every kernel: ns per sample, error against float64, share of the machine's bandwidth."""
    from mmsynth.bench.kernels import bench_kernels as measure

    with _bar("bench kernels", as_json) as show:
        report = measure(samples, out, threads, progress=show)
    _print_report(report, as_json)


@command("ablation", of=bench_app)
def bench_ablation(
    scene: SceneArgument,
    table: Annotated[str, typer.Option(help="engine, modalities, transfer, or a TOML file of variants")] = "engine",
    steps: Annotated[int | None, typer.Option(min=1, help="length of every fit in optimiser steps")] = None,
    budget: Annotated[str | None, typer.Option(help="or its time; default 60s")] = None,
    seeds: Annotated[str, typer.Option(help="every variant is fitted with each, e.g. 0,1,2")] = "0",
    only: Annotated[str | None, typer.Option(help="names of variants; the baseline is added")] = None,
    device: DeviceOption = "cpu",
    out: Annotated[Path, typer.Option(help="what is there already is not fitted again")] = Path("bench/ablation"),
    as_json: JsonOption = False,
) -> None:
    """What each choice is worth: variants of a fit against a baseline, in seconds and dB."""
    from mmsynth.bench.ablation import bench_ablation as measure
    from mmsynth.fitting.trainer import pick_device

    seconds = _length(steps, budget, "60s")
    chosen = None if only is None else [name.strip() for name in only.split(",")]
    with _bar("bench ablation", as_json) as show:
        report = measure(_scene_path(scene), table, out, steps, seconds, _seeds(seeds), chosen, show, pick_device(device))
    _print_report(report, as_json)


@command("numerics", of=bench_app)
def bench_numerics(
    only: Annotated[str | None, typer.Option(help="undistortion, opacity, normals, angles, demosaicking, resampling; default: all")] = None,
    out: Annotated[Path, typer.Option()] = Path("bench/numerics"),
    as_json: JsonOption = False,
) -> None:
    """What is computed approximately: ns per element against error, ours beside the usual ways."""
    from mmsynth.bench.numerics import bench_numerics as measure

    with _bar("bench numerics", as_json) as show:
        report = measure(out, None if only is None else [name.strip() for name in only.split(",")], progress=show)
    _print_report(report, as_json)


@command("twin", of=bench_app)
def bench_twin(
    only: Annotated[str | None, typer.Option(help="effects, optics, supersampling, calibration, spectra; default: all")] = None,
    run: Annotated[Path | None, typer.Option(help="a fitted field, whose supersampling is measured too")] = None,
    out: Annotated[Path, typer.Option()] = Path("bench/twin"),
    as_json: JsonOption = False,
) -> None:
    """The sensor's twin: ns per pixel of every effect against its closed form, supersampling, self-calibration, virtual channels."""
    from mmsynth.bench.twin import bench_twin as measure

    field = None if run is None else _load_field(run)[1]
    with _bar("bench twin", as_json) as show:
        report = measure(out, field, None if only is None else [name.strip() for name in only.split(",")], progress=show)
    _print_report(report, as_json)


@command("render", of=bench_app)
def bench_render(
    run: RunOption = None,
    only: Annotated[str | None, typer.Option(help="termination, steps, asked, tiles, threads; default: all")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="default: those of torch and numba")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="of each timing")] = 5,
    out: Annotated[Path, typer.Option()] = Path("bench/render"),
    as_json: JsonOption = False,
) -> None:
    """Rendering a fitted field: rays/s against error by early termination, sample budget, what is asked for, tiles and threads."""
    from mmsynth.bench.render import bench_render as measure

    _, field, scene = _load(run)
    with _bar("bench render", as_json) as show:
        report = measure(field, scene, out, None if only is None else [name.strip() for name in only.split(",")], threads, repeats, show)
    _print_report(report, as_json)


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

    if not re.fullmatch(r"\d+(,\d+)*", resolutions):
        raise InputError(f"--resolutions {resolutions!r}: expected numbers such as 128,256.")
    cells, chosen = [int(n) for n in resolutions.split(",")], None if methods is None else [m.strip() for m in methods.split(";")]
    with _bar("bench mesh", as_json) as show:
        report = measure(runs, out, cells, chosen, against, _lengths(distances), progress=show)
    _print_report(report, as_json)


def _print_report(report: Any, as_json: bool) -> None:
    from mmsynth.bench.tables import print_tables

    if as_json:
        print(json.dumps(report.results | {"out": str(report.out)}))
        return
    print_tables(report.tables)
    print(f"wrote {report.out}/ (results.json, report.md, plot.svg)")


def _tell(destination: Path, written: list[Path], as_json: bool) -> None:
    if as_json:
        print(json.dumps({"out": str(destination), "files": [str(p) for p in written]}))
    else:
        print(f"wrote {len(written)} files into {destination}/")


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="print the version")] = False) -> None:
    if version:
        from mmsynth.version import __version__

        print(__version__)
        raise typer.Exit


def main() -> None:
    """Entry point of the ``mmsynth`` command."""
    app()


if __name__ == "__main__":
    main()
