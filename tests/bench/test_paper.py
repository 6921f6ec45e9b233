"""The bench of the papers' tables: what it fits and how often, shares of processes, and the arithmetic, on results made by hand."""

from __future__ import annotations

import functools
import json
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import HEIGHT, WIDTH
from rows import measured

from mmsynth.bench import jobs, machine, paper
from mmsynth.bench.jobs import Job
from mmsynth.bench.paper import bench_paper
from mmsynth.errors import DivergedError, InputError
from mmsynth.fitting.recipe import Recipe
from mmsynth.operations.output.work_partition import WorkPartition
from mmsynth.packaged import data_folder
from mmsynth.scene.image_writers import write_png

pytestmark = pytest.mark.usefixtures("decided_by_few_rays")

EXAMPLE = data_folder("example_scene")
FIVE = ("rgb", "nir", "mono", "pol", "ms")


def invented(name: str, seed: int, fit: str) -> float:
    return 20.0 + zlib.crc32(f"{name} {seed} {fit}".encode()) / 2**32


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    """The jobs that were run, none of which really was."""
    made: list[Job] = []

    def fake(job: Job, run: Path) -> dict[str, Any]:
        made.append(job)
        result = measured(3.0, **{name: invented(name, job.seed, job.name) for name in job.modalities or FIVE})
        for scores in result["scores"]["modalities"].values():
            scores["psnr_view_mean"] = scores["psnr"] + 0.5
        return result

    monkeypatch.setattr(jobs, "run_job", fake)
    monkeypatch.setattr(paper, "measure", functools.cache(machine.measure))
    return made


@pytest.fixture
def two_scenes(write_mmsdata: Callable[..., Path]) -> list[Path]:
    """The example, and one with rgb and nir alone."""
    return [EXAMPLE, write_mmsdata(range(8))]


def lines(report: Any, table: str, score: str = "psnr") -> dict[str, dict[str, Any]]:
    (found,) = [t for t in report.results["tables"] if t["name"] == table]
    return {line["row"]: line for line in found["lines"] if line["score"] == score}


def test_cells_are_means_over_scenes_and_seeds(fits: list[Job], two_scenes: list[Path], tmp_path: Path) -> None:
    report = bench_paper(two_scenes, tmp_path / "out", Recipe(), ["together"], steps=3, seeds=[0, 4])
    value = lambda scene, fit, m: np.mean([invented(m, seed, f"{scene}-{fit}-seed{seed}") for seed in (0, 4)])
    alone, together = lines(report, "together")["alone"], lines(report, "together")["together"]
    assert alone["scenes"] == together["scenes"] == 2
    for m in ("rgb", "nir"):
        both = [value("example_scene", m, m), value("scene", m, m)]
        assert alone["modalities"][m] == pytest.approx(np.mean(both))
        both = [value("example_scene", "+".join(FIVE), m), value("scene", "rgb+nir", m)]
        assert together["modalities"][m] == pytest.approx(np.mean(both))
    for m in ("mono", "pol", "ms"):  # of the scene that has them
        assert alone["modalities"][m] == pytest.approx(value("example_scene", m, m))
    assert alone["mean"] == pytest.approx(np.mean([alone["modalities"][m] for m in FIVE]))
    view_mean = lines(report, "together", "psnr_view_mean")["alone"]["modalities"]
    assert view_mean == pytest.approx({m: value + 0.5 for m, value in alone["modalities"].items()})
    assert lines(report, "together", "seconds")["alone"]["modalities"] == dict.fromkeys(FIVE, 3.0)


def test_a_fit_that_several_tables_ask_for_is_made_once(fits: list[Job], tmp_path: Path) -> None:
    report = bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["together", "pairs", "rgb-only"], steps=3)
    assert len(fits) == 5 + 1 + 10 == len({job.name for job in fits}) == len(report.results["rows"])
    pairs = lines(report, "pairs")
    assert set(pairs) == {"alone", *(f"with {name}" for name in FIVE)}
    assert set(pairs["with rgb"]["modalities"]) == set(FIVE[1:]) and "mean" not in pairs["with rgb"]


def test_it_goes_on_where_it_was(fits: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = jobs.run_job

    def until_the_third(job: Job, run: Path) -> dict[str, Any]:
        if len(fits) == 3:
            raise KeyboardInterrupt
        return made(job, run)

    monkeypatch.setattr(jobs, "run_job", until_the_third)
    run = lambda: bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["together"], steps=3)
    with pytest.raises(KeyboardInterrupt):
        run()
    partial = json.loads((tmp_path / "out" / "results.json").read_text())
    assert len(partial["rows"]) == 3 and len(partial["unfinished"]) == 3
    monkeypatch.setattr(jobs, "run_job", made)
    report = run()
    assert len(fits) == 6 == len({job.name for job in fits}) and report.results["unfinished"] == []
    assert run().results["tables"] == report.results["tables"] and len(fits) == 6
    # another machine made them: they count all the same
    monkeypatch.setattr(jobs, "identify", lambda: {**report.results["machine"], "cpu": "another", "cores": 64, "threads": 64})
    assert run().results["tables"] == report.results["tables"] and len(fits) == 6


def test_a_fit_that_fails_stops_no_other_and_is_tried_again(fits: list[Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = jobs.run_job

    def broken(job: Job, run: Path) -> dict[str, Any]:
        if job.modalities == ("mono",):
            raise DivergedError("fit: it diverged.")
        return made(job, run)

    monkeypatch.setattr(jobs, "run_job", broken)
    report = bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["together"], steps=3)
    assert report.results["failed"] == {"example_scene-mono-seed0": "fit: it diverged."} and len(fits) == 5
    assert set(lines(report, "together")["alone"]["modalities"]) == {"rgb", "nir", "pol", "ms"}
    assert any("example_scene-mono-seed0 failed: fit: it diverged" in note for note in report.results["notes"])
    monkeypatch.setattr(jobs, "run_job", made)
    report = bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["together"], steps=3)
    assert report.results["failed"] == {} and len(fits) == 6 and "mean" in lines(report, "together")["alone"]


def test_processes_share_the_fits_and_the_last_makes_the_tables(fits: list[Job], tmp_path: Path) -> None:
    names: list[set[str]] = []
    for number in range(4):
        report = bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["pairs"], steps=3, part=WorkPartition(number, 4))
        names.append({job.name for job in fits} - set().union(*names))
        assert (report.files == ()) == (number < 3) == (not (tmp_path / "out" / "report.md").exists())
        assert len(report.results["unfinished"]) == 15 - len(fits)
    assert len(fits) == 15 == sum(map(len, names)) and all(names)
    alone = bench_paper([EXAMPLE], tmp_path / "other", Recipe(), ["pairs"], steps=3)
    assert alone.results["tables"] == report.results["tables"]
    # and any of them that runs again
    (tmp_path / "out" / "report.md").unlink()
    assert bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["pairs"], steps=3, part=WorkPartition(0, 4)).files


def test_what_scenes_have_nothing_for_is_left_out_and_said(fits: list[Job], write_mmsdata: Callable[..., Path], tmp_path: Path) -> None:
    def rgb_alone(meta: dict[str, Any]) -> None:
        del meta["modalities"]["infrared"]

    report = bench_paper([write_mmsdata(edit=rgb_alone)], tmp_path / "out", Recipe(), ["few-frames", "together", "rgb-only"], steps=3)
    assert [table["name"] for table in report.results["tables"]] == ["together", "rgb-only"]
    assert any("'few-frames' is left out" in note for note in report.results["notes"]) and len(fits) == 1
    assert lines(report, "together")["alone"]["modalities"] == lines(report, "together")["together"]["modalities"]


def test_a_modality_that_the_field_does_not_know_has_no_score(fits: list[Job], tmp_path: Path) -> None:
    report = bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["rgb-only"], steps=3)
    for score in ("psnr", "ssim", "seconds", "steps"):
        found = lines(report, "rgb-only", score)
        assert set(found["rgb only"]["modalities"]) == {"rgb"} and set(found["together"]["modalities"]) == set(FIVE)


def test_a_prior_is_for_rows_that_ask_for_one(fits: list[Job], tmp_path: Path) -> None:
    file = tmp_path / "prior.safetensors"
    file.write_bytes(b"one")
    report = bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["rgb-only"], steps=3, prior=file)
    assert {(job.name, job.prior) for job in fits} == {
        (f"{EXAMPLE.name}-rgb-seed0", None),
        (f"{EXAMPLE.name}-rgb-prior-seed0", str(file)),
        (f"{EXAMPLE.name}-rgb+nir+mono+pol+ms-seed0", None),
    }
    assert "rgb only, prior" in lines(report, "rgb-only")
    # another prior of that name is another fit, and the rest stay as they are
    file.write_bytes(b"two")
    bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["rgb-only"], steps=3, prior=file)
    assert len(fits) == 4 and fits[-1].prior == str(file)


def test_masks_are_learned_and_scored_with_and_part_of_a_result(
    fits: list[Job], write_mmsdata: Callable[..., Path], tmp_path: Path
) -> None:
    root, masks = write_mmsdata(), tmp_path / "masks"
    for name in ("rgb", "infrared"):
        for view in range(4):
            write_png(masks / name / f"{view:04d}.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    run = lambda: bench_paper([root], tmp_path / "out", Recipe(), ["rgb-only"], steps=3, masks="ignore", mask_folder=masks)
    run()
    run()
    assert len(fits) == 2
    for task in (job.task() for job in fits):
        for scene in (jobs.scene_of(task), jobs.whole_scene_of(task)):
            assert scene.masks == "ignore" and all(frame.mask and frame.mask.parent.parent == masks for frame in scene.frames)
    write_png(masks / "rgb" / "0000.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    run()
    assert len(fits) == 4


def test_foreground_by_the_fields_own_opacity_is_no_score(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fake(job: Job, run: Path) -> dict[str, Any]:
        result = measured(**dict.fromkeys(job.modalities or FIVE, 30.0))
        result["scores"]["modalities"]["rgb"]["foreground_from"] = "opacity"
        return result

    monkeypatch.setattr(jobs, "run_job", fake)
    report = bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["rgb-only"], steps=3)
    assert set(lines(report, "rgb-only", "psnr_foreground")) == {"together"}  # of the other modalities
    assert set(lines(report, "rgb-only", "psnr_foreground")["together"]["modalities"]) == set(FIVE[1:])


def test_tables_state_what_they_are_of(fits: list[Job], two_scenes: list[Path], tmp_path: Path) -> None:
    report = bench_paper(two_scenes, tmp_path / "out", Recipe(), ["together", "few-frames"], budget=120.0, seeds=[7])
    text = (tmp_path / "out" / "report.md").read_text()
    cores, threads = (report.results["machine"][key] for key in ("cores", "threads"))
    for table, rest in zip(report.tables, ("", "Left out"), strict=True):
        assert table.title in text and table.note in text and rest in table.note
        for part in ("Scenes: example_scene, scene; 2m a fit; seed 7.", "s in all", f"on {cores} cores, {threads} thread"):
            assert part in table.note
    assert "rgb + 25 frames" in report.tables[1].note and "rgb + 5 frames" not in report.tables[1].note
    assert report.files == ("results.json", "report.md", "report.html")
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == report.results


def test_rays_of_each_modality_are_equal_in_fits_of_equal_steps(fits: list[Job], tmp_path: Path) -> None:
    bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["together"], steps=3)
    usual = Recipe().sampling.samples_per_step
    assert {job.recipe.sampling.samples_per_step for job in fits if job.modalities} == {round(usual / 5)}
    bench_paper([EXAMPLE], tmp_path / "out", Recipe(), ["together"], budget=3.0)
    assert {job.recipe.sampling.samples_per_step for job in fits if job.steps is None} == {usual}


def test_bad_requests_run_nothing(fits: list[Job], tmp_path: Path, write_mmsdata: Callable[..., Path]) -> None:
    requests: list[tuple[dict[str, Any], str]] = [
        ({"steps": 3, "budget": 2.0}, "either"),
        ({}, "either"),
        ({"steps": 3, "seeds": [1, 1]}, "seeds"),
        ({"steps": 3, "tables": ["nonsense"]}, "nonsense"),
        ({"steps": 3, "scenes": [EXAMPLE, EXAMPLE]}, "two scenes"),
        ({"steps": 3, "scenes": []}, "no scene"),
        ({"steps": 3, "scenes": [tmp_path / "nowhere"]}, "nowhere"),
    ]
    for options, words in requests:
        with pytest.raises(InputError, match=words):
            bench_paper(**{"scenes": [EXAMPLE], "out": tmp_path / "out", "recipe": Recipe(), "tables": ["half"], **options})

    def without_rgb(meta: dict[str, Any]) -> None:
        del meta["modalities"]["rgb"]

    with pytest.raises(InputError, match=r"few-frames.*scene, with nir"):
        bench_paper([write_mmsdata(edit=without_rgb)], tmp_path / "out", Recipe(), ["few-frames"], steps=3)
    assert not fits and not (tmp_path / "out").exists()


def test_a_demosaicked_copy_is_fitted_and_the_raw_scene_scored(write_mmsdata: Callable[..., Path], tmp_path: Path) -> None:
    """A real fit in a process of its own; nothing of the copy is in the scene's folder."""
    root = write_mmsdata(range(4))
    before = sorted(root.rglob("*"))
    job = Job("one", str(root), Recipe(), None, {"nir": 2}, 0, 2, None, input="demosaicked", prepared=str(tmp_path / "prepared"))
    row = jobs.run_job(job, tmp_path / "run")
    assert set(row["scores"]["modalities"]) == {"rgb", "nir"} and row["scores"]["views"] == [3] and row["steps"] == 2
    assert sorted(root.rglob("*")) == before
    (copy,) = (tmp_path / "prepared").iterdir()
    learned = jobs.scene_of(job.task())
    assert learned.root == copy and learned.sensors["rgb"].mosaic is None
    assert len(learned.frames_of("nir")) == 3 and len(learned.frames_of("rgb")) == 4  # the test view is kept
    scene = jobs.scene_hash(jobs.whole_scene_of(job.task()))
    assert (
        jobs.identity(job, scene)
        == jobs.identity(replace(job, prepared="elsewhere"), scene)
        != jobs.identity(replace(job, input="raw"), scene)
    )
