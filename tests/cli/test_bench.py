"""``mmsynth bench`` and ``mmsynth fit --frames`` as a user runs them."""

from __future__ import annotations

import functools
import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from test_cli import run
from typer.testing import CliRunner

from mmsynth.bench import jobs, mesh, mesh_worker, render
from mmsynth.cli import app
from mmsynth.operations.mesh.quality import compare_meshes

pytestmark = pytest.mark.usefixtures("decided_by_few_rays")


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def call(*args: str) -> Any:
    """In this process: importing torch anew for every refusal takes seconds."""
    return CliRunner().invoke(app, args)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits of a bench; ``bench fit`` here and tests/bench/test_jobs.py have them in processes of their own."""

    def worked(module: str, task: Mapping[str, Any], name: str) -> dict[str, Any]:
        result: dict[str, Any] = json.loads(json.dumps(importlib.import_module(module).work(json.loads(json.dumps(task)))))
        return result

    monkeypatch.setattr(jobs, "in_a_process", worked)


def refused(result: Any, *words: str) -> None:
    """Exit code 2, one sentence on stderr, nothing on stdout."""
    assert result.exit_code == 2 and result.stdout == "", result.output
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ") and all(word in line for word in words), line


def test_bench_fit_goes_on_where_it_was(tmp_path: Path) -> None:
    result = run(tmp_path, "bench", "fit", "example", "--budgets", "0.3s", "--modalities", "rgb,pol", "--frames", "pol=2", "--json")
    assert result.returncode == 0, result.stderr
    results = json.loads(result.stdout)
    assert results["out"] == "bench/fit"
    (row,) = results["rows"]
    assert row["name"] == "0.3s" and row["seed"] == 0 and row["steps"] >= 1
    assert set(row["scores"]["modalities"]) == {"rgb", "pol"} and {"psnr", "psnr_truth", "psnr_truth_full"} <= set(row["mean"])
    out = tmp_path / "bench" / "fit"
    assert {path.name for path in out.iterdir()} == {"results.json", "report.md", "report.html", "plot.svg", "rows"}
    (file,) = (out / "rows").iterdir()
    made = file.stat().st_mtime_ns
    again = call("bench", "fit", "example", "--budgets", "0.3s", "--modalities", "rgb,pol", "--frames", "polarization=2")
    assert again.exit_code == 0, again.output
    assert "Error over time" in again.stdout and "wrote bench/fit/" in again.stdout
    assert file.stat().st_mtime_ns == made and len(list((out / "rows").iterdir())) == 1
    assert not (tmp_path / "runs").exists()


def test_bench_ablation(tmp_path: Path, in_this_process: None) -> None:
    (tmp_path / "table.toml").write_text('[[variant]]\nname = "both"\n[[variant]]\nname = "rgb"\nmodalities = ["rgb"]\n')
    result = call("bench", "ablation", "example", "--table", "table.toml", "--steps", "3", "--out", "here", "--json")
    assert result.exit_code == 0, result.output
    results = json.loads(result.stdout)
    assert results["out"] == "here" and [variant["name"] for variant in results["variants"]] == ["both", "rgb"]
    assert set(results["variants"][1]["difference"]["modalities"]) == {"rgb"}
    assert (tmp_path / "here" / "report.md").is_file()


def test_bench_paper(tmp_path: Path, in_this_process: None) -> None:
    head = 'title = "Two"\nsource = "nobody"\n'
    rows = '[[row]]\nname = "both"\nmodalities = ["rgb", "pol"]\n[[row]]\nname = "one"\nmodalities = ["rgb"]\n'
    (tmp_path / "two.toml").write_text(head + rows)
    command = ("bench", "paper", "example", "--tables", "two.toml", "--steps", "3", "--out", "here")
    result = call(*command, "--json")
    assert result.exit_code == 0, result.output
    results = json.loads(result.stdout)
    assert results["out"] == "here" and {row["fit"] for row in results["rows"]} == {"rgb+pol", "rgb"}
    (table,) = results["tables"]
    psnr = {line["row"]: line["modalities"] for line in table["lines"] if line["score"] == "psnr"}
    scores = {row["fit"]: row["scores"]["modalities"] for row in results["rows"]}
    assert psnr == {
        "both": {name: scores["rgb+pol"][name]["psnr"] for name in ("rgb", "pol")},
        "one": {"rgb": scores["rgb"]["rgb"]["psnr"]},
    }
    assert {"psnr_view_mean", "psnr_foreground", "ssim", "seconds"} <= {line["score"] for line in table["lines"]}
    made = {file: file.stat().st_mtime_ns for file in (tmp_path / "here" / "rows").iterdir()}
    again = call(*command)
    assert again.exit_code == 0 and "wrote here/ (results.json, report.md, report.html)" in again.stdout and "PSNR, pooled" in again.stdout
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "here" / "rows").iterdir()} == made


def test_bench_kernels(tmp_path: Path) -> None:
    result = call("bench", "kernels", "--samples", "256", "--threads", "1", "--json")
    assert result.exit_code == 0, result.output
    assert {row["operation"] for row in json.loads(result.stdout)["rows"]} == {"surface_value", "trace", "compare", "mirror", "adam"}
    assert (tmp_path / "bench" / "kernels" / "plot.svg").is_file()


def test_bad_requests_are_refused_in_one_sentence(tmp_path: Path) -> None:
    refused(call("bench", "fit", "nowhere"), "nowhere")
    refused(call("bench", "fit", "example", "--budgets", "15s,soon"), "--budgets", "soon")
    refused(call("bench", "fit", "example", "--recipe", "nothing"), "nothing")
    refused(call("bench", "fit", "example", "--frames", "pol"), "--frames", "pol=3")
    refused(call("bench", "fit", "example", "--frames", "pol=1,polarization=2"), "--frames")
    refused(call("bench", "fit", "example", "--frames", "thermal=1"), "thermal", "rgb")
    refused(call("bench", "ablation", "example", "--table", "nothing"), "nothing", "engine")
    refused(call("bench", "ablation", "example", "--seeds", "one"), "--seeds")
    refused(call("bench", "ablation", "example", "--steps", "3", "--budget", "3s"), "--steps", "--budget")
    refused(call("bench", "ablation", "example", "--only", "nothing"), "nothing", "baseline")
    refused(call("bench", "paper", "nowhere"), "nowhere")
    refused(call("bench", "paper", "example", "--tables", "half,nothing"), "nothing", "few-frames")
    refused(call("bench", "paper", "example", "--masks", "nowhere"), "--masks", "nowhere")
    refused(call("bench", "kernels", "--threads", "99999"), "--threads")
    refused(call("bench", "fit", "example", "--device", "tpu"), "--device", "cpu or cuda")
    refused(call("bench", "ablation", "example", "--device", "tpu"), "--device", "cpu or cuda")
    refused(call("fit", "example", "--frames", "pol=0"), "pol")
    assert not list(tmp_path.iterdir())
    (tmp_path / "bench").write_text("a file")
    refused(call("bench", "kernels", "--samples", "64"), "could not be written")


def test_a_fit_of_few_frames_is_scored_on_all_test_views(tmp_path: Path) -> None:
    result = call("fit", "example", "--steps", "3", "--modalities", "rgb,pol", "--frames", "pol=2", "--json")
    assert result.exit_code == 0, result.output
    scores = json.loads(call("evaluate", "--json").stdout)
    assert scores["views"] == json.loads((tmp_path / "runs/latest/manifest.json").read_text())["scene"]["test_views"]
    assert set(scores["modalities"]) == {"rgb", "pol"}


def test_bench_numerics(tmp_path: Path) -> None:
    result = call("bench", "numerics", "--only", "angles,resampling", "--json")
    assert result.exit_code == 0, result.output
    results = json.loads(result.stdout)
    assert results["out"] == "bench/numerics" and {row["family"] for row in results["rows"]} == {"angles", "resampling"}
    assert {path.name for path in (tmp_path / "bench" / "numerics").iterdir()} == {"results.json", "report.md", "report.html", "plot.svg"}
    refused(call("bench", "numerics", "--only", "magic"), "'magic'", "undistortion")


def test_bench_twin(tmp_path: Path) -> None:
    result = call("bench", "twin", "--only", "optics,spectra", "--out", "here")
    assert result.exit_code == 0 and "wrote here/" in result.output, result.output
    assert {path.name for path in (tmp_path / "here").iterdir()} == {"results.json", "report.md", "report.html", "plot.svg"}
    refused(call("bench", "twin", "--only", "magic"), "'magic'", "effects")
    refused(call("bench", "twin", "--run", "nowhere"), "nowhere", "no finished fit")


def test_bench_render(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "RAYS", 1000)  # what judges them takes hundreds of samples a ray
    assert call("fit", "example", "--steps", "3", "--modalities", "rgb,pol", "--json").exit_code == 0
    result = call("bench", "render", "--only", "asked", "--threads", "1", "--repeats", "1", "--json")
    assert result.exit_code == 0, result.output
    results = json.loads(result.stdout)
    assert results["out"] == "bench/render" and results["machine"]["threads"] == 1 and results["repeats"] == 1
    assert {row["method"].split(",")[0] for row in results["rows"]} == {"rgb", "pol", "all 2", "depth"}
    assert {path.name for path in (tmp_path / "bench" / "render").iterdir()} == {"results.json", "report.md", "report.html", "plot.svg"}
    refused(call("bench", "render", "--only", "magic"), "'magic'", "termination")
    refused(call("bench", "render", "--run", "nowhere"), "nowhere", "no finished fit")
    refused(call("bench", "render", "--threads", "99999"), "--threads")


def test_bench_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert call("fit", "example", "--steps", "25", "--modalities", "rgb", "--run", "run", "--json").exit_code == 0
    assert call("mesh", "--run", "run", "--resolution", "24", "--geometry-only", "--out", "true.ply", "--json").exit_code == 0
    size = ("bench", "mesh", "run", "--resolutions", "24", "--json")
    (alone,) = json.loads(call(*size, "--methods", "mmsynth, closed").stdout)["rows"]
    # that was in a process of its own
    monkeypatch.setattr(mesh, "in_a_process", lambda module, task, name: importlib.import_module(module).work(task))
    monkeypatch.setattr(mesh_worker, "compare_meshes", functools.partial(compare_meshes, samples=20_000))
    result = call(*size, "--methods", "every block; mmsynth, closed", "--against", "true.ply", "--distances", "0.01")
    assert result.exit_code == 0, result.output
    usual, ours = json.loads(result.stdout)["rows"]
    assert (usual["method"], ours["method"]) == ("every block", "mmsynth, closed")
    assert ours["mesh"] == alone["mesh"] and ours["mesh"]["watertight"] and ours["mesh"]["volume"] > 0
    for row in (usual, ours):
        assert row["resolution"] == 24 and row["seconds"] > 0 and row["peak_memory_bytes"] > 1e7
        assert row["against"]["accuracy"] < 0.27 / 24 and set(row["against"]["f_score"]) == {"0.01"}
    assert {path.name for path in (tmp_path / "bench" / "mesh").iterdir()} == {"results.json", "report.md", "report.html", "plot.svg"}
    refused(call("bench", "mesh", "run", "--methods", "magic"), "'magic'", "every block")
    refused(call("bench", "mesh", "nowhere"), "nowhere", "no finished fit")
    refused(call("bench", "mesh", "run", "--resolutions", "fine"), "fine", "128,256")
    refused(call("bench", "mesh", "run", "--against", "gt.ply"), "gt.ply")
