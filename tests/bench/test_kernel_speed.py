"""Speed beside error of every backend."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from mmsynth.bench import kernels as bench
from mmsynth.bench.kernels import OPERATIONS, Operation, available_backends, bench_kernels, time_operation
from mmsynth.field.kernels import cpu
from mmsynth.field.warmup import warm_up


@pytest.fixture(autouse=True)
def few_repeats(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "REPEATS", 2)


def test_report(tmp_path: Path) -> None:
    report = bench_kernels(512, tmp_path, threads=1)
    assert json.loads((tmp_path / "results.json").read_text()) == report.results
    assert report.results["machine"]["threads"] == 1
    pairs = [(row["operation"], row["backend"]) for row in report.results["rows"]]
    assert len(set(pairs)) == len(pairs)
    assert {(o, b) for o in ("surface_value", "trace", "adam") for b in ("torch", "numba")} <= set(pairs)
    # a row of the reference alone would say nothing
    assert ("hash_encode", "torch") not in pairs or ("hash_encode", "torch cuda") in pairs
    text = (tmp_path / "report.md").read_text()
    assert "surface_value" in text and "gradient error" in text and (tmp_path / "plot.svg").is_file()


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda o: o.name)
def test_every_backend_is_right(operation: Operation) -> None:
    rows = time_operation(operation, available_backends(), 2048, 10.0)
    assert [row["backend"] for row in rows] == [b for b in available_backends() if b in operation.calls]
    for row in rows:
        assert row["samples"] > 500 and row["forward_ns"] > 0 and row["forward_ratio"] > 0
        assert row["value_error"] < 2e-3 * row["value_scale"] and row.get("differing_rays", 0.0) < 0.05
        assert ("both_ns" in row) == ("gradient_error" in row) == (operation.leaves is not None)
        if operation.leaves:
            assert row["gradient_error"] < 5e-3 * row["gradient_scale"] and row["gradient_scale"] > 0
        assert ("bandwidth_share" in row) == (operation.traffic is not None and row["backend"] in ("torch", "numba"))
    assert rows[0]["forward_ratio"] == 1.0


@pytest.mark.parametrize("samples", [1, 7, 8, 1000])
def test_inputs_have_the_samples_asked_for(samples: int) -> None:
    for operation in OPERATIONS:
        first, again = operation.make(samples), operation.make(samples)
        for key, value in first.items():
            if isinstance(value, torch.Tensor):
                assert torch.equal(value, again[key])
            else:
                assert all(torch.equal(a, b) for a, b in zip(value.parameters(), again[key].parameters(), strict=True))
        if operation.name not in ("trace", "march"):  # there the rays decide
            assert operation.count(operation.calls["torch"](first)) == samples


def test_a_wrong_kernel_is_seen() -> None:
    def double(inputs: dict[str, Any]) -> tuple[torch.Tensor]:
        return (2 * inputs["x"],)

    def wrong(inputs: dict[str, Any]) -> tuple[torch.Tensor]:
        x = inputs["x"]
        return (2 * x + 0.25 * x.detach() + x.clamp(max=0),)

    operation = Operation(
        "double",
        lambda samples: {"x": torch.linspace(-1, 1, samples)},
        {"torch": double, "numba": wrong, "other": wrong},
        leaves=lambda inputs: [inputs["x"]],
        traffic=lambda inputs, samples: (8.0 * samples, 16.0 * samples),
    )
    rows = time_operation(operation, {"torch": "cpu", "numba": "cpu", "triton": "cpu"}, 101, 1.0)
    assert [row["backend"] for row in rows] == ["torch", "numba"]  # the third is not there, the fourth does not offer it
    assert rows[0]["value_error"] < 1e-6 and rows[0]["gradient_error"] < 1e-6 and rows[0]["value_scale"] == pytest.approx(2.0)
    assert rows[1]["value_error"] == pytest.approx(1.25) and rows[1]["gradient_error"] > 0.5
    assert rows[0]["bandwidth_share"] == pytest.approx(8.0 / rows[0]["forward_ns"])
    assert rows[0]["both_bandwidth_share"] == pytest.approx(16.0 / rows[0]["both_ns"])


def test_of_several_gradients_the_worst_is_reported() -> None:
    operation = Operation(
        "sum",
        lambda samples: {"large": torch.ones(samples), "small": torch.ones(samples)},
        {
            "torch": lambda x: (1e6 * x["large"] + 1e-3 * x["small"],),
            "numba": lambda x: (1e6 * x["large"] + 2e-3 * x["small"],),
        },
        leaves=lambda x: [x["large"], x["small"]],
    )
    rows = time_operation(operation, {"torch": "cpu", "numba": "cpu"}, 50, 1.0)
    assert rows[1]["gradient_error"] == pytest.approx(rows[1]["gradient_scale"], rel=1e-3) and rows[1]["gradient_scale"] < 1.0


def test_rays_of_another_length_are_counted_and_left_out() -> None:
    truth = torch.tensor([1.0, 2.0, 3.0]).double(), torch.tensor([0, 0, 1]), torch.tensor([0, 2, 3])
    ours = torch.tensor([1.0, 3.5]), torch.tensor([0, 1]), torch.tensor([0, 1, 2])
    march = next(o for o in OPERATIONS if o.name == "march")
    assert march.difference(ours, truth) == (0.5, 0.5)


def test_what_is_compiled_ahead_is_all_that_runs(capsys: pytest.CaptureFixture[str]) -> None:
    warm_up()
    assert cpu.is_compiled()
    state = torch.get_rng_state()
    before = [list(k.signatures) for k in cpu.KERNELS]
    warm_up.__wrapped__()
    assert capsys.readouterr().err == "" and torch.equal(torch.get_rng_state(), state)
    for operation in OPERATIONS:
        if "numba" in operation.calls:
            time_operation(operation, {"torch": "cpu", "numba": "cpu"}, 300, 1.0)
    assert [list(k.signatures) for k in cpu.KERNELS] == before and all(len(s) == 1 for s in before)
