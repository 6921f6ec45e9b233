"""The commands as a user runs them: in a folder of their own, on the packaged example scene; each once as a process of its own."""

import contextlib
import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from few_looks import few_looks
from typer.testing import CliRunner

from mmsynth.cli import app
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene

pytestmark = pytest.mark.usefixtures("decided_by_few_rays")

ROOT = Path(__file__).parents[2]


def run(cwd: Path, *args: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", **variables}
    return subprocess.run([sys.executable, "-m", "mmsynth", *args], cwd=cwd, env=environment, capture_output=True, text=True)


def here(cwd: Path, *args: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """The same in this process: importing torch anew takes seconds."""
    before = Path.cwd()
    os.chdir(cwd)
    try:
        result = CliRunner(env={"COLUMNS": "200", **variables}).invoke(app, args)
    finally:
        os.chdir(before)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return subprocess.CompletedProcess(args, result.exit_code, result.stdout, result.stderr)


@contextlib.contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    """The kernel lets none grow past it, as a full disk would."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def refused(result: subprocess.CompletedProcess[str], *words: str) -> None:
    """Exit code 2, one sentence on stderr, nothing on stdout, no traceback."""
    assert result.returncode == 2, result.stderr
    lines = [x for x in result.stderr.splitlines() if not x.startswith("compiling kernels")]
    assert len(lines) == 1 and lines[0].startswith("error: "), result.stderr
    for word in words:
        assert word in lines[0], lines[0]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("work")
    with pytest.MonkeyPatch.context() as patch:
        few_looks(patch)
        result = here(folder, "fit", "example", "--steps", "25", "--json")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["steps"] == 25
    return folder


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A copy of the example scene to break."""
    return Path(shutil.copytree(data_folder("example_scene"), tmp_path / "scene"))


@pytest.mark.parametrize(
    "command",
    [
        "evaluate",
        "convert --from rgb --to ms",
        "simulate --sensor mmsdata_rgb",
        "calibrate-noise",
        "mesh",
        "video",
        "view",
        "generate-dataset",
    ],
)
def test_a_device_that_is_none_is_refused_before_anything_is_opened(tmp_path: Path, command: str) -> None:
    refused(here(tmp_path, *command.split(), "--device", "tpu"), "--device 'tpu': expected auto, cpu or cuda")


def test_fit_leaves_a_run(tmp_path: Path) -> None:
    result = run(tmp_path, "fit", "example", "--steps", "3", "--json")
    assert result.returncode == 0 and json.loads(result.stdout)["steps"] == 3, result.stderr
    latest = tmp_path / "runs" / "latest"
    assert latest.resolve() == (tmp_path / "runs" / "example_scene").resolve()
    for name in ("field.safetensors", "manifest.json", "train.jsonl", "report.html", "preview.png", "checkpoint/state.pt"):
        assert (latest / name).stat().st_size > 0, name
    assert not list(tmp_path.rglob("*.tmp*"))


def test_info(tmp_path: Path) -> None:
    result = here(tmp_path, "info", "example")
    assert result.returncode == 0 and "ms" in result.stdout and "24 frames" in result.stdout.replace("frames    24", "24 frames")
    assert set(json.loads(here(tmp_path, "info", "example", "--json").stdout)["sensors"]) == {"rgb", "nir", "mono", "pol", "ms"}


def test_evaluate(fitted: Path) -> None:
    result = run(fitted, "evaluate", "--json")
    assert result.returncode == 0, result.stderr
    scores = json.loads(result.stdout)
    assert set(scores["modalities"]) == {"rgb", "nir", "mono", "pol", "ms"}
    for modality in scores["modalities"].values():
        assert {"psnr", "psnr_foreground", "ssim", "psnr_truth"} <= set(modality)
        assert modality["foreground_from"] == "gt"
    assert scores["rays_per_s"] > 0 and scores["seconds"]


def test_masks_of_a_folder_are_learned_from_and_remembered(tmp_path: Path) -> None:
    """An archive of masks as MMS-DATA has it, beside the example; a fit that they mean an object to, scored with the same ones."""
    for frame in load_scene(data_folder("example_scene")).frames:
        inside = np.zeros((frame.camera.height, frame.camera.width), np.uint8)
        inside[len(inside) // 4 : -len(inside) // 4, inside.shape[1] // 4 : -inside.shape[1] // 4] = 255
        path = tmp_path / f"archive/masks/scenes/example_scene/modalities/{frame.source_name}/mask_{frame.view}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), inside)
    about = json.loads(here(tmp_path, "info", "example", "--masks", "archive", "--json").stdout)
    assert about["masks"] == "off" and all(0 < sensor["foreground_percent"] < 50 for sensor in about["sensors"].values())
    result = here(tmp_path, "fit", "example", "--masks", "archive", "--masks", "object", "--steps", "3", "--modalities", "rgb,mono")
    assert result.returncode == 0 and "masks: object: nothing is outside; inside are rgb 25" in result.stdout, result.stdout + result.stderr
    (tmp_path / "elsewhere").mkdir()
    scores = json.loads(here(tmp_path / "elsewhere", "evaluate", "--run", "../runs/latest", "--json").stdout)["modalities"]
    assert {m["foreground_from"] for m in scores.values()} == {"masks"} and all("psnr_foreground_view_mean" in m for m in scores.values())
    assert "view mean" in here(tmp_path, "evaluate", "--masks", "ignore").stdout
    refused(here(tmp_path, "fit", "example", "--masks", "nowhere"), "nowhere", "expected one of masks, or object, ignore or off")
    refused(here(tmp_path, "fit", "example", "--masks", "off", "--masks", "object"), "expected one of object, ignore, off, and one folder")
    refused(here(tmp_path, "info", "example", "--masks", "elsewhere"), "elsewhere", "none of its 0 pictures")


def test_convert(fitted: Path) -> None:
    result = run(fitted, "convert", "--from", "rgb", "--to", "ms", "--views", "9")
    assert result.returncode == 0, result.stderr
    (file,) = (fitted / "runs/latest/convert/rgb_to_ms").rglob("*.npz")
    found = np.load(file)
    assert found["data"].shape == (72, 96, 9) and found["confidence"].shape == (72, 96)
    own = here(fitted, "convert", "--from", "rgb", "--to", "nir", "--views", "9", "--method", "ratio", "--as-sensor", "--out", "own")
    assert own.returncode == 0 and (fitted / "own/nir/0009.npz").is_file(), own.stderr
    frame = next((data_folder("example_scene") / "modalities" / "rgb").glob("*9.png"))
    # a fit of 25 steps has no surface to find a frame by
    refused(here(fitted, "convert", "--from", "rgb", "--to", "ms", "--images", str(frame)), frame.name)
    refused(here(fitted, "convert", "--from", "rgb", "--to", "ms", "--images", str(frame), "--views", "9"), "--images")
    refused(here(fitted, "convert", "--from", "rgb", "--to", "ms", "--method", "magic"), "magic", "guided")


def test_every_public_name_is_there() -> None:
    import mmsynth

    assert all(callable(getattr(mmsynth, name)) for name in mmsynth.__all__)
    assert set(mmsynth.__all__) == set(mmsynth._HOMES)


def test_convert_at_poses(fitted: Path, tmp_path: Path) -> None:
    (tmp_path / "orbit.json").write_text(json.dumps({"trajectory": "orbit", "views": 2}))
    orbit = ("--poses", str(tmp_path / "orbit.json"))
    result = here(fitted, "convert", "--from", "rgb", "--to", "pol", *orbit, "--format", "exr", "--out", "orbit", "--json")
    assert result.returncode == 0, result.stderr
    assert {"0000.exr", "0001.exr", "0001.json"} < {Path(p).name for p in json.loads(result.stdout)["files"]}
    refused(here(fitted, "convert", "--from", "rgb", "--to", "pol", *orbit, "--method", "guided"), "needs frames of rgb")
    refused(here(fitted, "convert", "--from", "rgb", "--to", "pol", *orbit, "--views", "9"), "--views", "--poses")


METHODS = ("ratio", "guided", "linear", "nearest")


def test_evaluate_conversions(fitted: Path) -> None:
    result = here(fitted, "evaluate", "--convert", "rgb:ms,mono:pol", "--json")
    assert result.returncode == 0, result.stderr
    first, second = json.loads(result.stdout)["conversions"]
    assert (first["source"], first["target"], first["truth"]) == ("rgb", "ms", "aligned")
    assert sum(first["auto"].values()) == pytest.approx(1.0) and set(first["evidence"]["psnr"]) == {"field", *METHODS}
    assert {"auto", "field", *METHODS} == set(second["methods"]) and second["truth"] == "own pose"
    assert {"psnr", "sam", "ergas", "ssim", "rmse"} <= set(first["methods"]["guided"])
    table = here(fitted, "evaluate", "--convert", "rgb:mono")
    assert table.returncode == 0 and "\n  auto: " in table.stdout and "training views: field" in table.stdout
    refused(here(fitted, "evaluate", "--convert", "rgb-ms"), "rgb-ms", "rgb:ms")
    refused(here(fitted, "evaluate", "--convert", "rgb:thermal"), "thermal")


def test_generate_dataset_resumes_and_verifies(fitted: Path) -> None:
    result = run(fitted, "generate-dataset", "--poses", "poses.json", "--modalities", "rgb,pol")
    assert result.returncode == 0, result.stderr
    dataset = fitted / "runs/latest/dataset"
    before = {p: p.stat().st_mtime_ns for p in dataset.rglob("*.npz")}
    assert len(json.loads((dataset / "dataset.json").read_text())["views"]) == 12 and before
    assert here(fitted, "generate-dataset", "--poses", "poses.json", "--modalities", "rgb,pol").returncode == 0
    assert {p: p.stat().st_mtime_ns for p in dataset.rglob("*.npz")} == before
    assert here(fitted, "generate-dataset", "--poses", "poses.json", "--verify").returncode == 0
    victim = next(iter(before))
    victim.write_bytes(victim.read_bytes()[:-5])
    refused(here(fitted, "generate-dataset", "--poses", "poses.json", "--verify"), "problem")


def test_generate_dataset_leaves_out_what_no_frame_saw(fitted: Path, tmp_path: Path) -> None:
    """Two of the example scene's poses, and one that looks away from the scene."""
    content = json.loads((data_folder("example_scene") / "poses.json").read_text())
    frames = content["frames"][:2]
    away = (np.array(frames[0]["transform_matrix"]) @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist()
    content["frames"] = [*frames, {**frames[0], "file_path": "away.png", "transform_matrix": away}]
    (fitted / "three.json").write_text(json.dumps(content))
    args = ("generate-dataset", "--poses", "three.json", "--modalities", "rgb", "--out", str(tmp_path / "out"))
    result = here(fitted, *args, "--min-coverage", "0.3")
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert lines[0].startswith("left out 1 of 3 views with a coverage below 0.3: away (0.") and lines[1].startswith("wrote 2 views")
    assert len(json.loads((tmp_path / "out/dataset.json").read_text())["views"]) == 2
    facts = json.loads(here(fitted, *args, "--min-coverage", "0.3", "--json").stdout)
    assert facts["views"] == 2 and facts["left_out"][0]["name"] == "away" and facts["left_out"][0]["coverage_score"] < 0.3
    refused(here(fitted, *args, "--min-coverage", "30"), "--min-coverage 30", "from 0 to 1")
    refused(here(fitted, *args, "--min-coverage", "1"), "the best of 3 views")


def test_two_processes_make_the_dataset_of_one(fitted: Path, tmp_path: Path) -> None:
    (tmp_path / "orbit.json").write_text(json.dumps({"trajectory": "orbit", "views": 5}))
    (tmp_path / "nir.toml").write_text(MONO_TOML)
    few = ("--modalities", "mono,nir", "--outputs", "geometry,flow", "--sensor", str(tmp_path / "nir.toml"), "--seed", "3")
    command = ("generate-dataset", "--poses", str(tmp_path / "orbit.json"), *few)
    assert here(fitted, *command, "--out", str(tmp_path / "one")).returncode == 0
    outputs = []
    for rank in ("1", "0"):
        result = here(fitted, *command, "--out", str(tmp_path / "two"), RANK=rank, WORLD_SIZE="2")
        assert result.returncode == 0, result.stderr
        outputs.append(result.stdout)
    assert "process 1 of 2" in outputs[0] and "wrote 5 views" in outputs[1]
    one, two = (
        {str(p.relative_to(tmp_path / n)): p.read_bytes() for p in (tmp_path / n).rglob("*.*") if p.is_file()} for n in ("one", "two")
    )
    assert one == two and {"dataset.json", "raw/meta_data.json", "views/0004/geometry.npz", "views/0003/flow.npz"} < set(one)
    result = here(fitted, *command, "--out", str(tmp_path / "two"), "--verify", "--json")
    assert json.loads(result.stdout)["problems"] == []
    raw = next(p for p in (tmp_path / "two/raw/modalities").rglob("*.png"))
    raw.write_bytes(raw.read_bytes()[:-3])
    refused(here(fitted, *command, "--out", str(tmp_path / "two"), "--verify"), "1 problems", raw.name)
    refused(here(fitted, *command, "--out", "no", "--raw"), "mono.toml")
    refused(here(fitted, *command, "--out", "no", RANK="2", WORLD_SIZE="2"), "RANK")


def test_a_batch_goes_on_after_a_scene_that_fails(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "good").symlink_to(scene)
    (tmp_path / "bad").mkdir()
    (tmp_path / "list.txt").write_text("bad  # holds nothing\n\ngood\n")
    (tmp_path / "orbit.json").write_text(json.dumps({"trajectory": "orbit", "views": 2}))
    command = ("batch", "list.txt", "--steps", "12", "--modalities", "mono,nir", "--poses", "orbit.json", "--format", "webdataset")
    command = (*command, "--masks", "ignore")
    result = here(tmp_path, *command)
    assert result.returncode == 2 and "1 of 2 scenes failed" in result.stderr and "bad" in result.stderr
    assert json.loads((tmp_path / "batch/bad/outcome.json").read_text())["error"].startswith("bad")
    name = scene.resolve().name
    outcome = json.loads((tmp_path / "batch" / name / "outcome.json").read_text())
    assert Path(tmp_path / outcome["dataset"]).is_file() and (tmp_path / outcome["run"] / "report.html").is_file()
    before = (tmp_path / outcome["run"] / "manifest.json").read_bytes()
    assert json.loads(before)["scene"]["masks"] == "ignore"
    again = here(tmp_path, *command, "--json")
    assert again.returncode == 2 and set(json.loads(again.stdout)["scenes"]) == {"bad", name}
    assert (tmp_path / outcome["run"] / "manifest.json").read_bytes() == before
    refused(here(tmp_path, "batch", "nothing.txt"), "nothing.txt")
    (tmp_path / "twice.txt").write_text("good\ngood\n")
    refused(here(tmp_path, "batch", "twice.txt"), "twice.txt", name)


MONO_TOML = """name = "nir"
instance_of = "nir"
[noise]
bits = 12
gain_dn_e = 0.4
full_well_e = 12000.0
read_e = 5.0
"""


def test_simulate_is_a_scene_that_can_be_fitted_again(fitted: Path, tmp_path: Path) -> None:
    sensors = json.loads(here(fitted, "info", "example", "--json").stdout)["sensors"]
    name = next(n for n, s in sensors.items() if s["mosaic"] is None)
    (fitted / "own.toml").write_text(MONO_TOML.replace("nir", name))
    (fitted / "rgb.toml").write_text(MONO_TOML.replace("nir", "rgb"))
    result = run(fitted, "simulate", "--sensor", "own.toml", "--sensor", "rgb.toml", "--views", "all", "--json")
    assert result.returncode == 0, result.stderr
    out = Path(json.loads(result.stdout)["scene"])
    assert out == Path("runs/latest/simulated")
    again = json.loads(here(fitted, "info", str(out), "--json").stdout)
    assert set(again["sensors"]) == {name, "rgb"} and not again["problems"]
    assert all(again["sensors"][n]["frames"] == sensors[n]["frames"] for n in again["sensors"])
    assert again["sensors"]["rgb"]["bits"] == 12 and again["sensors"]["rgb"]["mosaic"] == sensors["rgb"]["mosaic"]
    assert here(tmp_path, "fit", str(fitted / out), "--steps", "3").returncode == 0
    # a trajectory, a packaged virtual camera, DNG
    (fitted / "orbit.json").write_text('{"trajectory": "orbit", "views": 3}')
    small = (data_folder("recipes") / "sensors" / "bayer_rgb.toml").read_text()
    small = small.replace("width = 1440", "width = 72").replace("height = 1080", "height = 54").replace("1739.1", "87.0")
    (fitted / "small.toml").write_text(small.replace("cx = 719.5", "cx = 35.5").replace("cy = 539.5", "cy = 26.5"))
    result = here(fitted, "simulate", "--sensor", "small.toml", "--poses", "orbit.json", "--format", "dng", "--out", "dng", "--seed", "5")
    assert result.returncode == 0 and "wrote dng/" in result.stdout, result.stderr
    assert sorted(p.name for p in (fitted / "dng" / "modalities" / "bayer_rgb").iterdir()) == ["0000.dng", "0001.dng", "0002.dng"]


def test_bad_simulations_are_refused(fitted: Path) -> None:
    (fitted / "psf.toml").write_text(MONO_TOML.replace("nir", "rgb").replace("[noise]", "psf_sigma_px = 1.0\n[noise]"))
    (fitted / "rgb.toml").write_text(MONO_TOML.replace("nir", "rgb"))
    (fitted / "key.toml").write_text(MONO_TOML.replace("read_e", "read_noise"))
    refused(here(fitted, "simulate", "--sensor", "psf.toml"), "one of --poses and --views")
    refused(here(fitted, "simulate", "--sensor", "psf.toml", "--views", "test"), "psf.toml", "psf_sigma_px", "--delta")
    refused(here(fitted, "simulate", "--sensor", "key.toml", "--views", "test"), "key.toml", "read_noise")
    refused(here(fitted, "simulate", "--sensor", "nothing", "--views", "test"), "nothing", "bayer_rgb")
    refused(here(fitted, "simulate", "--sensor", "rgb.toml", "--views", "test", "--rig", "aligned"), "--rig")
    refused(here(fitted, "simulate", "--sensor", "rgb.toml", "--views", "777"), "777")


def test_calibrate_noise(fitted: Path, tmp_path: Path) -> None:
    assert here(tmp_path, "fit", "example", "--modalities", "nir", "--steps", "200").returncode == 0
    result = here(tmp_path, "calibrate-noise", "--out", "sensors")
    assert result.returncode == 0, result.stderr
    assert "gain [DN/e-]" in result.stdout and "wrote sensors/ (nir.toml, noise.svg)" in result.stdout
    assert {p.name for p in (tmp_path / "sensors").iterdir()} == {"nir.toml", "noise.svg", "noise.json"}
    again = here(tmp_path, "simulate", "--sensor", "sensors/nir.toml", "--views", "test", "--json")
    assert again.returncode == 0, again.stderr
    # raw frames alone
    frames = sorted(str(p) for p in (data_folder("example_scene") / "modalities" / "infrared").iterdir())[:3]
    alone = here(tmp_path, "calibrate-noise", "--sensor", "sensors/nir.toml", *frames, "--json")
    assert alone.returncode == 0 and json.loads(alone.stdout)["sensors"]["nir"]["frames"] == 3, alone.stderr
    refused(here(tmp_path, "calibrate-noise", *frames), "expected one --sensor")
    refused(here(tmp_path, "calibrate-noise", "--raw", "nowhere"), "nowhere", "no frames")
    refused(here(fitted, "calibrate-noise", "--modalities", "rgb"), "rgb", "explains", "expected at least 75%")  # after 25 steps


def test_mesh(fitted: Path) -> None:
    import trimesh

    result = run(fitted, "mesh", "--resolution", "48", "--closed", "--keep", "all", "--json")
    assert result.returncode == 0, result.stderr
    mesh = trimesh.load(fitted / "runs/latest/mesh.ply", process=False)
    report = json.loads(result.stdout)
    assert len(mesh.faces) == report["faces"] > 100
    assert report["watertight"] and mesh.is_watertight and mesh.volume == pytest.approx(report["volume"], rel=1e-4)
    assert report["residual"]["rms_cells"] < 1e-3 and report["unit"] == "m" and set(report["seconds"]) == {"extract", "report", "write"}
    assert np.abs(mesh.vertices - np.array([0.0, 0.0, 0.105])).max() < 0.28  # metres, in the scene's own frame
    names = mesh.metadata["_ply_raw"]["vertex"]["data"].dtype.names
    assert {"rgb_0", "ms_8", "pol_dolp", "pol_axis_x", "nir_0", "quality", "views"} <= set(names)
    assert b"comment unit m\n" in (fitted / "runs/latest/mesh.ply").read_bytes()[:5000]
    again = here(
        fitted, "mesh", "--resolution", "48", "--geometry-only", "--out", "a.obj", "--against", "runs/latest/mesh.ply", "--faces", "600"
    )
    assert again.returncode == 0 and "wrote a.obj" in again.stdout and "F-score" in again.stdout, again.stderr


def test_doctor(tmp_path: Path) -> None:
    facts = json.loads(here(tmp_path, "doctor", "--json").stdout)
    assert facts["versions"]["torch"] and facts["cores"] >= 1


def test_bad_scenes_are_refused_in_one_sentence(scene: Path, tmp_path: Path) -> None:
    refused(here(tmp_path, "fit", "nowhere"), "nowhere")
    meta = scene / "meta_data.json"
    good = meta.read_text()

    meta.write_text(good[:200])
    refused(here(tmp_path, "fit", "scene"), "meta_data.json", "line")

    broken = json.loads(good)
    broken["modalities"]["rgb"]["frames"][3]["camtoworld"][1][2] = float("nan")
    meta.write_text(json.dumps(broken))
    refused(here(tmp_path, "fit", "scene"), "meta_data.json", "rgb")

    far = json.loads(good)
    for modality in far["modalities"].values():
        for frame in modality["frames"]:
            for row in frame["camtoworld"]:
                row[3] += 1000.0
    meta.write_text(json.dumps(far))
    refused(here(tmp_path, "fit", "scene"), "region")

    meta.write_text(good)
    refused(here(tmp_path, "fit", "scene", "--modalities", "rgb,thermal"), "thermal", "rgb")
    refused(here(tmp_path, "fit", "scene", "--recipe", "nothing"), "nothing")
    refused(here(tmp_path, "fit", "scene", "--budget", "soon"), "soon")
    refused(here(tmp_path, "fit", "scene", "--resume"), "resume")

    image = scene / "modalities" / "mono" / "0004.png"
    image.write_bytes(image.read_bytes()[:-100])
    refused(here(tmp_path, "fit", "scene", "--steps", "5"), "0004.png")
    assert not (tmp_path / "runs").exists()


def test_commands_without_a_fit_are_refused(tmp_path: Path) -> None:
    for args in (("evaluate",), ("mesh",), ("convert", "--from", "rgb", "--to", "ms"), ("generate-dataset", "--poses", "poses.json")):
        refused(here(tmp_path, *args), "fit")


def test_bad_requests_on_a_run_are_refused(fitted: Path) -> None:
    refused(here(fitted, "convert", "--from", "rgb", "--to", "thermal"), "thermal", "ms")
    refused(here(fitted, "convert", "--from", "rgb", "--to", "ms", "--views", "777"), "777")
    refused(here(fitted, "convert", "--from", "rgb,ms", "--to", "pol"), "rgb,ms")
    refused(here(fitted, "generate-dataset", "--poses", "missing.json"), "missing.json")
    refused(here(fitted, "mesh", "--out", "mesh.xyz", "--resolution", "16"), "mesh.xyz")
    refused(here(fitted, "mesh", "--against", "gt.ply", "--resolution", "16"), "gt.ply")
    refused(here(fitted, "mesh", "--keep", "some", "--resolution", "16"), "'some'", "largest")
    refused(here(fitted, "mesh", "--distances", "near", "--resolution", "16"), "near", "0.001,0.002")
    refused(here(fitted, "mesh", "--min-views", "99", "--geometry-only", "--resolution", "16"), "99", "training views")
    (fitted / "nan.json").write_text('{"convention": "OpenCV", "rig": [[[NaN,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]]}')
    refused(here(fitted, "generate-dataset", "--poses", "nan.json"), "nan.json")


def test_a_full_disk_leaves_nothing_half_written(fitted: Path, tmp_path: Path) -> None:
    with no_file_larger_than(100_000):
        refused(here(tmp_path, "fit", "example", "--steps", "3"), "could not be written")
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]
    for args in (
        ("mesh", "--resolution", "64", "--out", str(tmp_path / "m.ply")),
        ("convert", "--from", "rgb", "--to", "ms", "--out", str(tmp_path / "c")),
    ):
        with no_file_larger_than(20_000):
            refused(here(fitted, *args), "could not be written")
    assert not [p for p in tmp_path.rglob("*") if p.is_file() and p.suffix != ".json" and p.stat().st_size == 20_000]
    assert not list(tmp_path.rglob("*tmp*"))


def test_importing_sets_no_environment_variable_and_leaves_plots_and_solvers_for_later() -> None:
    """Which took a quarter of a command's imports."""
    code = """
import os, sys, cv2, torch
before = dict(os.environ)
import mmsynth, mmsynth.workflows.fit, mmsynth.bench.worker, mmsynth.operations.conversion.files, mmsynth.operations.dataset.generate
assert dict(os.environ) == before
assert not {"matplotlib", "scipy.ndimage", "scipy.optimize", "scipy.spatial", "tifffile"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
