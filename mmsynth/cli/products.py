"""Commands that make something of a field: convert, generate-dataset, simulate, calibrate-noise, mesh, export."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from mmsynth.cli.arguments import (
    AlsoOption,
    DeviceOption,
    ImagesOption,
    JsonOption,
    MasksOption,
    RunOption,
    lengths,
    masks_of,
    modality_names,
    scene_path,
    sensor_folders,
    view_ids,
)
from mmsynth.cli.terminal import command, print_written, progress_bar
from mmsynth.errors import InputError

if TYPE_CHECKING:
    from mmsynth.operations.conversion.methods import Method
    from mmsynth.operations.dataset.plan import DatasetFormat
    from mmsynth.operations.export.plans import ExportLayout
    from mmsynth.operations.output.records import RecordFormat
    from mmsynth.operations.simulation.simulate import FrameFormat, Split
    from mmsynth.operations.views.load import Rig


@command("convert")
def convert(
    source: Annotated[str, typer.Option("--from", help="modality whose frames give pose and pixel grid")],
    target: Annotated[str, typer.Option("--to", help="modality to synthesise")],
    run: RunOption = None,
    views: Annotated[str | None, typer.Option(help="view ids, e.g. 9,19; default: all frames of the source")] = None,
    method: Annotated[str, typer.Option(help="auto, field, ratio, guided, linear or nearest")] = "auto",
    images: Annotated[
        list[Path] | None,
        typer.Option(help="frames of the source without poses, one option for each file; with --poses: matched to the poses by name"),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="poses of the source, as for generate-dataset; without --images the field alone is rendered")
    ] = None,
    as_sensor: Annotated[
        bool, typer.Option("--as-sensor", help="from the target's own place, through its lens; else on the source's pixels")
    ] = False,
    file_format: Annotated[str, typer.Option("--format", help="npz, exr or tiff")] = "npz",
    out: Annotated[Path | None, typer.Option(help="default: RUN/convert/FROM_to_TO")] = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Convert frames of one modality into another, at the frames' poses or at any poses."""
    from mmsynth.files import read_json
    from mmsynth.fitting.device import pick_device
    from mmsynth.operations.conversion.files import convert_files
    from mmsynth.report.conversion import source_previews, write_conversion_report
    from mmsynth.report.text import converted_text
    from mmsynth.scene.scene import canonical_modality
    from mmsynth.workflows.runs import open_run

    opened = open_run(run, device=pick_device(device))
    folder, field, scene = opened.folder, opened.field, opened.scene
    if views is not None and (images or poses):
        raise InputError("--views: frames of the scene are converted with it, expected it without --images and --poses.")
    destination = out or folder / "convert" / f"{canonical_modality(source)}_to_{canonical_modality(target)}"
    with progress_bar(f"{source} to {target}", as_json) as show:
        written = convert_files(
            field, scene, destination, source=source, target=target, frames=view_ids(views), views=poses, images=images or (),
            method=cast("Method", method), as_sensor=as_sensor, file_format=cast("RecordFormat", file_format), progress=show,
        )  # fmt: skip
    sidecars = [path for path in written if path.suffix == ".json"]
    if not as_json:
        print(converted_text([read_json(path) for path in sidecars]))
    sensor = field.sensors[canonical_modality(source)]
    written.append(write_conversion_report(destination, sidecars, sensor, source_previews(scene, sensor, images or ())))
    print_written(destination, written, as_json)


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
        str | None,
        typer.Option(
            help="in addition to the modalities: any of geometry,flow,coverage,light, or none; default: all but light", metavar="NAMES"
        ),
    ] = None,
    min_coverage: Annotated[
        float | None, typer.Option(help="leave out views whose mean coverage by the training frames is below this, 0 to 1")
    ] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(help="also simulate raw frames of this sensor (file or packaged name), one option for each; into OUT/raw"),
    ] = None,
    raw: Annotated[
        bool,
        typer.Option(
            "--raw", help="also simulate raw frames of the field's own sensors, with the noise that calibrate-noise found (RUN/sensors)"
        ),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="of the raw frames' noise")] = 0,
    out: Annotated[Path | None, typer.Option(help="default: RUN/dataset")] = None,
    file_format: Annotated[str, typer.Option("--format", help="npz, exr, tiff, webdataset or mms-data")] = "npz",
    device: DeviceOption = "auto",
    verify: Annotated[bool, typer.Option("--verify", help="only check a finished dataset against its checksums")] = False,
    as_json: JsonOption = False,
) -> None:
    """Render an aligned dataset: every modality, depth, normals, opacity, coverage, flow, intrinsics and pose of each view. Under torchrun
    every process makes its share."""
    from mmsynth.fitting.device import pick_device
    from mmsynth.operations.dataset import generate as dataset
    from mmsynth.operations.dataset.index import verify_dataset
    from mmsynth.operations.output.work_partition import local_device, partition_of_environment
    from mmsynth.report.dataset import write_dataset_report
    from mmsynth.workflows.runs import latest_run, open_run

    if verify:
        destination = out or (run or latest_run()) / "dataset"
        problems = verify_dataset(destination)
        if problems:
            raise InputError(f"{destination}: {len(problems)} problems, first: {problems[0]}")
        print(json.dumps({"out": str(destination), "problems": []}) if as_json else f"{destination}: complete, every checksum matches")
        return
    part = partition_of_environment()
    opened, names = open_run(run, device=local_device(pick_device(device))), modality_names(modalities)
    folder, field, scene = opened.folder, opened.field, opened.scene
    destination = out or folder / "dataset"
    with progress_bar("dataset", as_json) as show:
        made = dataset.generate_dataset(
            field, poses, destination, scene=scene, modalities=names, rig=cast("Rig", rig),
            file_format=cast("DatasetFormat", file_format),
            outputs=None if outputs is None else [] if outputs == "none" else [name.strip() for name in outputs.split(",")],
            min_coverage=min_coverage,
            sensors=[*(sensor or ()), *(folder / "sensors" / f"{name}.toml" for name in (names or field.sensors) if raw)], seed=seed,
            part=part, progress=show,
        )  # fmt: skip
    if made.path is not None:
        write_dataset_report(made.path.parent)
    if as_json:
        unseen = [{"name": name, "coverage_score": score} for name, score in made.left_out]
        print(json.dumps({"dataset": None if made.path is None else str(made.path), "views": made.views, "left_out": unseen}))
        return
    if made.left_out:
        named = ", ".join(f"{name} ({score:.2f})" for name, score in made.left_out)
        given = made.views + len(made.left_out)
        print(f"left out {len(made.left_out)} of {given} views with a coverage below {min_coverage:g}: {named}")
    if made.path is None:
        print(f"process {part.number} of {part.processes}: its share of {made.views} views is in {destination}/, others are at work")
    else:
        print(f"wrote {made.views} views into {destination}/")


@command("simulate")
def simulate(
    sensor: Annotated[list[str], typer.Option(help="sensor file, or the name of a packaged one; once per sensor of the rig")],
    poses: Annotated[Path | None, typer.Option(help="of the rig's reference: as for generate-dataset")] = None,
    views: Annotated[
        str | None, typer.Option(help="instead of --poses: frames of the scene: train, test, all, or ids such as 9,19")
    ] = None,
    run: RunOption = None,
    rig: Annotated[str, typer.Option(help="native: each sensor at its place on the rig; aligned: all at the poses")] = "native",
    delta: Annotated[
        bool, typer.Option("--delta", help="instances only: apply the file's effects on top of those that the field has learned")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="of noise and fixed patterns")] = 0,
    file_format: Annotated[str, typer.Option("--format", help="png, tiff or dng")] = "png",
    out: Annotated[Path | None, typer.Option(help="default: RUN/simulated")] = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Simulate the raw frames of sensors; the result is a scene that can be fitted again."""
    from mmsynth.fitting.device import pick_device
    from mmsynth.operations.output.work_partition import local_device, partition_of_environment
    from mmsynth.operations.simulation import simulate as twins
    from mmsynth.workflows.runs import open_run

    part = partition_of_environment()
    opened = open_run(run, device=local_device(pick_device(device)))
    folder, field, scene = opened.folder, opened.field, opened.scene
    destination = out or folder / "simulated"
    with progress_bar("simulate", as_json) as show:
        written = twins.simulate(
            field, sensor, destination, views=poses,
            frames=cast("Split", views) if views in ("train", "test", "all") else view_ids(views), scene=scene, rig=cast("Rig", rig),
            delta=delta, seed=seed, file_format=cast("FrameFormat", file_format), part=part, progress=show,
        )  # fmt: skip
    if as_json:
        print(json.dumps({"scene": str(destination)}))
        return
    if written is None:
        print(f"process {part.number} of {part.processes}: its share of the frames is in {destination}/, others are at work")
        return
    for line in twins.expected_errors(written.parent):
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
        list[str] | None, typer.Option(help="sensor files that give bits, black level and alignment; default: taken from the frames")
    ] = None,
    raw: Annotated[Path | None, typer.Option(help="other frames at the same poses, of any exposure: RAW/MODALITY/0009.png")] = None,
    views: Annotated[str | None, typer.Option(help="view ids, e.g. 9,19; default: those of the training")] = None,
    out: Annotated[Path | None, typer.Option(help="default: RUN/sensors, or sensors")] = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Measure gain, read noise and PRNU by photon transfer, into sensor files; from a scene's frames and field, or frames alone."""
    from mmsynth.fitting.device import pick_device
    from mmsynth.operations.simulation import calibrate_noise as noise
    from mmsynth.report.text import noise_text
    from mmsynth.sensors.sensor_file import find_sensor_file, load_sensor
    from mmsynth.workflows.runs import open_run

    files = [load_sensor(find_sensor_file(name)) for name in sensor or []]
    failed: dict[str, str] = {}
    if frames:
        if len(files) != 1:
            raise InputError(f"calibrate-noise: {len(files)} sensor files for these frames, expected one --sensor that describes them.")
        destination, calibrated = out or Path("sensors"), {files[0].name: noise.calibrate_from_frames(files[0], frames)}
        noise.write(calibrated, destination)
    else:
        opened = open_run(run, device=pick_device(device))
        destination = out or opened.folder / "sensors"
        with progress_bar("noise", as_json) as show:
            calibrated, failed = noise.calibrate_noise(
                opened.field, opened.scene, modalities=modality_names(modalities), known=noise.by_modality(files), raw=raw,
                views=view_ids(views), out=destination, progress=show,
            )  # fmt: skip
    if calibrated:
        facts = {"out": str(destination), "sensors": {n: c.to_json() for n, c in calibrated.items()}}
        print(json.dumps(facts) if as_json else noise_text(calibrated, destination))
    if failed:
        raise InputError(" ".join(failed.values()))


@command("mesh")
def mesh(
    run: RunOption = None,
    resolution: Annotated[int, typer.Option(min=8, max=8192, help="cells across the region of interest")] = 256,
    out: Annotated[Path | None, typer.Option(help="PLY, GLB, OBJ or STL; default: RUN/mesh.ply")] = None,
    closed: Annotated[bool, typer.Option("--closed", help="close the surface where the region's border cuts it")] = False,
    keep: Annotated[str, typer.Option(help="components to keep: clean (all but specks), all, largest, or a number")] = "clean",
    min_views: Annotated[int, typer.Option(min=0, help="keep only components that this many training views see")] = 0,
    faces: Annotated[int | None, typer.Option(min=4, help="decimate to so many")] = None,
    max_error: Annotated[
        float | None, typer.Option(help="or decimate while 99.9 % of the surface stays within this distance [scene unit]")
    ] = None,
    geometry_only: Annotated[bool, typer.Option("--geometry-only", help="no colours and no modalities on the vertices")] = False,
    against: Annotated[Path | None, typer.Option(help="score it against this mesh, in the same frame and unit")] = None,
    distances: Annotated[str | None, typer.Option(help="of the F-score, e.g. 0.001,0.002; default: 0.5, 1 and 2 % of the radius")] = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Extract the surface as a mesh with every modality on its vertices, in the input's frame and unit."""
    from mmsynth.fitting.device import pick_device
    from mmsynth.operations.mesh.extract import MeshOptions, keep_of, mesh_to_file
    from mmsynth.report.text import mesh_text
    from mmsynth.workflows.runs import open_field, open_run

    if geometry_only and not min_views and against is None:
        (folder, field), scene = open_field(run, device=pick_device(device)), None  # the scene may be elsewhere
    else:
        opened = open_run(run, device=pick_device(device))
        folder, field, scene = opened.folder, opened.field, opened.scene
    destination, at = out or folder / "mesh.ply", lengths(distances)
    options = MeshOptions(
        resolution, keep=keep_of(keep), closed=closed, attributes=not geometry_only, min_views=min_views, faces=faces, max_error=max_error
    )
    with progress_bar("mesh", as_json) as show:
        report = mesh_to_file(field, destination, options, scene=scene, against=against, distances=at, progress=show)
    print(json.dumps(report) if as_json else mesh_text(report))


@command("export")
def export(
    layout: Annotated[str, typer.Option(help="mms-data, nerfstudio or colmap")],
    source: Annotated[
        str | None, typer.Argument(metavar="[SCENE|RUN]", help="scene folder, or run folder for poses as the fit corrected them; "
                                   "default: the last fit made in this folder")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="default: SCENE-LAYOUT in this folder, or RUN/export/LAYOUT")] = None,
    images: ImagesOption = None,
    also: AlsoOption = None,
    masks: MasksOption = None,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Write a scene in another layout: pictures byte for byte, poses, lenses, masks, test views, sparse points."""
    from mmsynth.operations.export.export import export_scene
    from mmsynth.report.text import export_text
    from mmsynth.scene.load import load_scene
    from mmsynth.workflows.runs import is_run, open_run

    meaning, folder = masks_of(masks)
    if source is None or is_run(Path(source)):
        if images or also or masks:
            raise InputError("--images, --also, --masks: a run has the pictures that it was fitted to, expected them with a scene.")
        opened = open_run(None if source is None else Path(source))
        scene, field, destination = opened.scene, opened.field, out or opened.folder / "export" / layout
    else:
        scene, field = load_scene(scene_path(source), images=images, also=sensor_folders(also), masks=meaning, mask_folder=folder), None
        destination = out or Path(f"{scene.root.resolve().name}-{layout}")
    with progress_bar("export", as_json) as show:
        written = export_scene(scene, destination, layout=cast("ExportLayout", layout), field=field, progress=show)
    print(json.dumps(written.facts()) if as_json else export_text(written.facts()))
