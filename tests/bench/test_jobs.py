"""Fits in processes of their own: results kept, matched and made once."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rows import measured, scores

from mmsynth.bench import jobs as jobs_module
from mmsynth.bench.jobs import Job, code_hash, identity, mean_over_modalities, run_job, run_jobs, scene_hash
from mmsynth.errors import DivergedError, InputError
from mmsynth.fitting.checkpoint import read_checkpoint
from mmsynth.fitting.recipe import Recipe
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene

ROOT = Path(__file__).parents[2]
EXAMPLE = str(data_folder("example_scene"))
JOB = Job("one", EXAMPLE, Recipe(), ("rgb", "pol"), {"pol": 3}, 0, 4, None)


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of the jobs that were run, none of which really was."""
    names: list[str] = []

    def fake(job: Job, run: Path) -> dict[str, Any]:
        names.append(job.name)
        return measured()

    monkeypatch.setattr(jobs_module, "run_job", fake)
    yield names


def test_one_real_fit_in_a_process_of_its_own(tmp_path: Path) -> None:
    row = run_job(JOB, tmp_path / "run")
    json.dumps(row, allow_nan=False)
    assert row["steps"] == 4 and row["seconds"] > 0 and row["peak_memory_bytes"] > 1e7 and 0 < row["cpu_share"] < 1.2
    assert row["rays_per_s"] > 0 and row["samples_per_s"] > 0 and row["render_rays_per_s"] > 0
    assert set(row["scores"]["modalities"]) == {"rgb", "pol"}
    assert row["scores"]["views"] == list(load_scene(EXAMPLE).split.test)


def test_a_sensor_alone_is_scored_where_all_are(tmp_path: Path) -> None:
    """Truth at the RGB pose needs the pose of the RGB frames and not the RGB sensor in the field."""
    row = run_job(dataclasses.replace(JOB, modalities=("pol",), frames={}), tmp_path / "run")
    assert set(row["scores"]["modalities"]) == {"pol"}
    assert "psnr_aligned" in row["scores"]["modalities"]["pol"] and "depth_mae" in row["scores"]["geometry"]


def test_what_the_child_refuses_is_one_sentence_here(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected one of rgb.*[^.]\.$") as refused:
        run_job(dataclasses.replace(JOB, modalities=("thermal",)), tmp_path / "run")
    assert "\n" not in str(refused.value) and not str(refused.value).startswith("error")


def test_a_child_that_dies_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs_module.sys, "executable", "/bin/false")
    with pytest.raises(InputError, match="one: its process ended with status 1 instead of a score"):
        run_job(JOB, tmp_path / "run")


def test_a_fit_ends_with_the_bench_that_started_it(tmp_path: Path) -> None:
    """While it reads its scene, here."""
    task = json.dumps(dataclasses.replace(JOB, steps=None, budget=3600.0).task() | {"run": str(tmp_path / "run"), "began": 0.0})
    command = [sys.executable, "-m", "mmsynth.bench.worker", task, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, cwd=ROOT, stderr=subprocess.DEVNULL) as child:
        assert child.stdin is not None
        child.stdin.close()
        try:
            assert child.wait(timeout=120) in (-signal.SIGTERM, 128 + signal.SIGTERM)
        finally:
            child.kill()
    assert not (tmp_path / "result.json").exists()


def test_a_fit_in_the_middle_goes_on_and_its_time_counts(tmp_path: Path) -> None:
    """Ended by Ctrl-C in the bench's own process, which is all that a terminal's group has: the fit's is in a session of its own."""
    job = dataclasses.replace(JOB, modalities=("mono",), frames={}, steps=None, budget=6.0)
    names = "from pathlib import Path; from mmsynth.bench.jobs import Job, run_jobs; from mmsynth.fitting.recipe import *"
    code = f"{names}; list(run_jobs([{job!r}], Path({str(tmp_path)!r})))"
    state = lambda: read_checkpoint(next((tmp_path / "rows").glob("one-*"), tmp_path))
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stderr=subprocess.DEVNULL) as bench:
        try:
            limit = time.monotonic() + 240.0
            while state() is None and time.monotonic() < limit:  # one of no step is written before the first
                time.sleep(0.1)
            time.sleep(1.0)
            bench.send_signal(signal.SIGINT)
            assert bench.wait(timeout=120) != 0
        finally:
            bench.kill()
    saved = state()
    assert saved is not None and not list((tmp_path / "rows").glob("*.json"))
    before = saved["state"]
    assert 0 < before["step"] and 0.0 < before["elapsed"] < 6.0
    (row,) = run_jobs([job], tmp_path)
    assert row["earlier_seconds"] == before["elapsed"] and row["steps"] > before["step"]
    assert 6.0 <= row["seconds"] and row["earlier_seconds"] < row["seconds"]
    assert [path.suffix for path in (tmp_path / "rows").iterdir()] == [".json"]


def test_a_fit_that_diverged_starts_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def diverge(job: Job, run: Path) -> dict[str, Any]:
        (run / "checkpoint").mkdir(parents=True)
        raise DivergedError("fit: it diverged.")

    monkeypatch.setattr(jobs_module, "run_job", diverge)
    for _ in range(2):
        with pytest.raises(DivergedError):
            list(run_jobs([JOB], tmp_path))
    assert not list((tmp_path / "rows").glob("*"))


def test_a_result_that_is_there_is_not_made_again(fits: list[str], tmp_path: Path) -> None:
    two = [JOB, dataclasses.replace(JOB, name="two", seed=1)]
    first = list(run_jobs(two, tmp_path))
    assert fits == ["one", "two"] and [row["name"] for row in first] == ["one", "two"] and [row["seed"] for row in first] == [0, 1]
    assert list(run_jobs(two, tmp_path)) == first and fits == ["one", "two"]
    assert len(list((tmp_path / "rows").glob("*.json"))) == 2 and len(list((tmp_path / "rows").iterdir())) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 7},
        {"device": "cuda"},
        {"steps": 5},
        {"steps": None, "budget": 4.0},
        {"recipe": Recipe().with_changes({"loss.eikonal_weight": 0.3})},
        {"modalities": None},
        {"frames": {"pol": 2}},
    ],
)
def test_another_task_is_another_result(fits: list[str], tmp_path: Path, change: dict[str, Any]) -> None:
    list(run_jobs([JOB], tmp_path))
    list(run_jobs([dataclasses.replace(JOB, **change)], tmp_path))
    assert fits == ["one", "one"]


def test_edited_code_is_another_result(fits: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert code_hash() == code_hash()
    list(run_jobs([JOB], tmp_path))
    monkeypatch.setattr(jobs_module, "code_hash", lambda: "edited")
    list(run_jobs([JOB], tmp_path))
    assert fits == ["one", "one"]


def test_a_killed_bench_keeps_what_was_finished(fits: list[str], tmp_path: Path) -> None:
    three = [dataclasses.replace(JOB, name=name) for name in "abc"]
    going = run_jobs(three, tmp_path)
    next(going), next(going)
    del going
    list(run_jobs(three, tmp_path))
    assert fits == ["a", "b", "c"]


def test_bad_jobs_are_refused_before_the_first_fit(fits: list[str], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="thermal"):
        list(run_jobs([JOB, dataclasses.replace(JOB, modalities=("thermal",))], tmp_path))
    assert fits == [] and not list(tmp_path.iterdir())


def test_a_broken_result_is_named(fits: list[str], tmp_path: Path) -> None:
    list(run_jobs([JOB], tmp_path))
    (file,) = (tmp_path / "rows").iterdir()
    file.write_text("{")
    with pytest.raises(InputError, match=file.name):
        list(run_jobs([JOB], tmp_path))


def test_the_scene_hash_covers_pixels_and_poses(write_mmsdata: Any) -> None:
    from mmsynth.scene.image_writers import write_png16
    from mmsynth.scene.images import read_native

    root = write_mmsdata()
    before = scene_hash(load_scene(root))
    assert scene_hash(load_scene(root)) == before
    image = next((root / "modalities" / "rgb").iterdir())
    original, pixels = image.read_bytes(), read_native(image)
    write_png16(image, 1.0 - pixels)
    assert scene_hash(load_scene(root)) != before
    image.write_bytes(original)
    assert scene_hash(load_scene(root)) == before
    meta = json.loads((root / "meta_data.json").read_text())
    meta["modalities"]["rgb"]["frames"][0]["camtoworld"][0][3] += 1e-6
    (root / "meta_data.json").write_text(json.dumps(meta))
    assert scene_hash(load_scene(root)) != before


def test_identity_is_json() -> None:
    json.dumps(identity(JOB, "hash"), allow_nan=False)


def test_means_are_over_the_modalities_that_have_a_score() -> None:
    mean = mean_over_modalities(scores(rgb=30.0, ms=26.0))
    assert mean["psnr"] == 28.0 and mean["psnr_truth"] == 27.0 and mean["sam"] == 4.0
    assert "foreground_from" not in mean and "aolp_mae" not in mean
