"""Error over time, with fits that are made up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from rows import measured

from mmsynth.bench import fit as bench
from mmsynth.bench import jobs
from mmsynth.bench.jobs import Job
from mmsynth.errors import InputError
from mmsynth.fitting.recipe import load_recipe
from mmsynth.packaged import data_folder

EXAMPLE = data_folder("example_scene")


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    made: list[Job] = []

    def fake(job: Job, run: Path) -> dict[str, Any]:
        made.append(job)
        assert job.budget is not None
        return measured(job.budget + 1, rgb=20 + job.budget, ms=18 + job.budget)

    monkeypatch.setattr(jobs, "run_job", fake)
    return made


def test_one_fit_per_budget_and_three_files(fits: list[Job], tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    report = bench.bench_fit(
        EXAMPLE, [4.0, 2.0], tmp_path, load_recipe(None), ["rgb", "ms"], {"ms": 3}, 5, lambda done, total: calls.append((done, total))
    )
    assert [(job.name, job.budget, job.steps, job.seed) for job in fits] == [("2s", 2.0, None, 5), ("4s", 4.0, None, 5)]
    assert all(job.modalities == ("rgb", "ms") and job.frames == {"ms": 3} for job in fits)
    assert [row["mean"]["psnr"] for row in report.results["rows"]] == [21.0, 23.0]
    assert json.loads((tmp_path / "results.json").read_text()) == report.results
    text = (tmp_path / "report.md").read_text()
    for part in ("# mmsynth bench fit", "GFLOP/s", "| 2s |", "| 4s |", "rgb", "21.00", "plot.svg"):
        assert part in text
    assert "normals" not in text  # none of the scores has them
    assert (tmp_path / "plot.svg").read_text().count("<svg") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"results.json", "report.md", "report.html", "plot.svg", "rows"}
    assert calls == [(0, 2), (1, 2), (2, 2)]


def test_budgets_that_are_there_are_skipped(fits: list[Job], tmp_path: Path) -> None:
    bench.bench_fit(EXAMPLE, [2.0], tmp_path, load_recipe(None))
    report = bench.bench_fit(EXAMPLE, [2.0, 3.0], tmp_path, load_recipe(None))
    assert [job.name for job in fits] == ["2s", "3s"] and [row["name"] for row in report.results["rows"]] == ["2s", "3s"]


def test_a_scene_without_truth_has_one_panel_and_no_such_column() -> None:
    row = {"name": "1s", **measured(), "mean": {"psnr": 29.0}}
    for modality in row["scores"]["modalities"].values():
        del modality["psnr_truth"]
    row["scores"]["geometry"] = {}
    assert len(bench.plot([row]).axes) == 1
    headings = [column.heading for table in bench.tables_of([row]) for column in table.filled()]
    assert "truth [dB]" not in headings and "Chamfer" not in headings and "raw [dB]" in headings


@pytest.mark.parametrize("budgets", [[], [2.0, 2.0]])
def test_bad_budgets(budgets: list[float], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="budgets"):
        bench.bench_fit(EXAMPLE, budgets, tmp_path, load_recipe(None))


def test_budget_names() -> None:
    assert [bench.budget_name(s) for s in (0.5, 15.0, 60.0, 90.0, 600.0, 3600.0)] == ["0.5s", "15s", "1m", "90s", "10m", "1h"]
