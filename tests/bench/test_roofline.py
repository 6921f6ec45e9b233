"""The roofline: what must hold of any figures in it."""

import dataclasses

import pytest

from mmsynth.bench.roofline import GPUS, Sizes, roofline_table, rows, works


def test_a_step_takes_the_sum_of_what_binds() -> None:
    found = rows(gpus=GPUS[:1])
    *parts, whole = found
    assert whole["us"] == pytest.approx(sum(part[part["binds"]] for part in parts))
    assert whole["samples_per_s"] == pytest.approx(Sizes().samples / whole["us"] * 1e6)
    assert len(parts) == len(works(Sizes()))


def test_with_twice_the_samples_a_step_takes_less_than_twice_as_long() -> None:
    one, two = (rows(Sizes(samples=samples), GPUS[1:])[-1] for samples in (1 << 18, 1 << 19))
    assert one["samples_per_s"] < two["samples_per_s"] and one["us"] < two["us"] < 2 * one["us"]


def test_a_gpu_of_twice_the_limits_is_twice_as_fast() -> None:
    gpu = GPUS[0]
    limits = {f.name: 2 * getattr(gpu, f.name) for f in dataclasses.fields(gpu) if f.name not in ("name", "launch")}
    faster = dataclasses.replace(gpu, **limits, launch=gpu.launch / 2)
    assert rows(gpus=(faster,))[-1]["us"] == pytest.approx(rows(gpus=(gpu,))[-1]["us"] / 2)


def test_the_table_says_what_binds_and_what_would_disprove_it() -> None:
    table = roofline_table()
    assert {row["gpu"] for row in table.rows} == {"H100", "H200"} and "Disproved" in table.note
