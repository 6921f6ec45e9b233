"""Error over time by the size of frames, with fits that are made up."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from analytic import AnalyticField, scene_of, sphere
from rows import measured

from mmsynth.bench import jobs
from mmsynth.bench.jobs import Job
from mmsynth.bench.size import bench_size, make_scenes
from mmsynth.errors import InputError
from mmsynth.fitting.recipe import load_recipe
from mmsynth.scene.load import load_scene

SCALES = [Fraction(1, 4), Fraction(1, 2)]


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    made: list[Job] = []

    def fake(job: Job, run: Path) -> dict[str, Any]:
        made.append(job)
        assert job.budget is not None
        return measured(job.budget + 1, rgb=20 + job.budget)

    monkeypatch.setattr(jobs, "run_job", fake)
    return made


@pytest.fixture
def scenes(tmp_path: Path) -> dict[Fraction, Path]:
    """Of two scales of a full size of 96 pixels in a row."""
    field: Any = AnalyticField(sphere())
    return make_scenes(field, scene_of(field, tmp_path / "small", truth=False), SCALES, tmp_path / "out", width=96, views=3)


def test_a_fit_for_each_size_and_time(scenes: dict[Fraction, Path], fits: list[Job], tmp_path: Path) -> None:
    assert [path.name for path in scenes.values()] == ["1-4", "1-2"]
    assert [load_scene(path).frames[0].camera.width for path in scenes.values()] == [24, 48]
    report = bench_size(scenes, [4.0, 2.0], tmp_path / "out", load_recipe(None), seed=5)
    assert [(job.name, job.budget, job.seed) for job in fits] == [("1-4-2s", 2, 5), ("1-2-2s", 2, 5), ("1-4-4s", 4, 5), ("1-2-4s", 4, 5)]
    assert [row["photosites"] for row in report.results["rows"]] == [2 * 4 * 24 * 18, 2 * 4 * 48 * 36] * 2
    text = (tmp_path / "out" / "report.md").read_text()
    for part in ("| 1/4 |", "| 1/2 |", "start-up [s]", "22.00", "plot.svg"):
        assert part in text
    bench_size(scenes, [4.0, 2.0], tmp_path / "out", load_recipe(None), seed=5)
    assert len(fits) == 4


def test_bad_scales_and_times(scenes: dict[Fraction, Path], fits: list[Job], tmp_path: Path) -> None:
    field: Any = AnalyticField(sphere())
    small = scene_of(field, tmp_path / "small", truth=False)
    for scales in ([], [Fraction(0)], [Fraction(1, 4), Fraction(2, 8)]):
        with pytest.raises(InputError, match="scales"):
            make_scenes(field, small, scales, tmp_path / "none")
    with pytest.raises(InputError, match="2 to 4"):
        make_scenes(field, small, SCALES, tmp_path / "none", views=9)
    assert not (tmp_path / "none").exists()
    with pytest.raises(InputError, match="budgets"):
        bench_size(scenes, [2.0, 2.0], tmp_path / "out", load_recipe(None))
    assert not fits
