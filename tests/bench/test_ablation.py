"""Tables of variants, and the arithmetic of their differences on results made by hand."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from rows import measured

from mmsynth.bench import jobs
from mmsynth.bench.ablation import Variant, bench_ablation, compare, load_table, plot, tables_of
from mmsynth.bench.jobs import Job
from mmsynth.errors import InputError
from mmsynth.fitting.recipe import Recipe
from mmsynth.packaged import data_folder

EXAMPLE = data_folder("example_scene")
PACKAGED = sorted(path.stem for path in (data_folder("recipes") / "bench").glob("*.toml"))


@pytest.mark.parametrize("name", PACKAGED)
def test_packaged_tables_change_something_but_the_baseline(name: str) -> None:
    baseline, *others = load_table(name)
    assert baseline.changes == {} and others
    for variant in others:
        # a default that was moved onto a variant leaves that variant with nothing to tell
        assert variant.modalities or variant.frames or variant.fitted_recipe() != Recipe(), variant.name


def test_the_three_tables_are_there() -> None:
    assert PACKAGED == ["engine", "modalities", "transfer"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("variant = 3", "variant"),
        ("", "variant"),
        ("[[variant", "not valid TOML"),
        ("[[variant]]\nname = 'a'\nreason = 'b'", "variant.0.reason"),
        ("[[variant]]\nname = 'a/b'", "variant.0.name"),
        ("[[variant]]\nname = 'a'\n[[variant]]\nname = 'b'\nrecipe = { loss.speed = 3 }", "'b': recipe.loss.speed"),
        ("[[variant]]\nname = 'a'\n[[variant]]\nname = 'b'\nrecipe = { loss.eikonal_weight = -1 }", "'b': recipe.loss.eikonal_weight"),
        ("[[variant]]\nname = 'a'\n[[variant]]\nname = 'a'", "twice"),
        ("[[variant]]\nname = 'a'\nrecipe = { loss.eikonal_weight = 0.2 }", "baseline"),
    ],
)
def test_bad_tables_are_refused_in_one_sentence(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "table.toml"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        load_table(str(path))
    assert words in str(refused.value) and str(path) in str(refused.value) and "\n" not in str(refused.value)


def test_missing_tables(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected one of engine, modalities, transfer"):
        load_table("nonsense")
    with pytest.raises(InputError, match="could not be read"):
        load_table(str(tmp_path / "none.toml"))


def row(variant: str, seed: int, seconds: float, **psnr: float) -> dict[str, Any]:
    return {"name": f"{variant}-seed{seed}", "variant": variant, "seed": seed, "cores": 2, "threads": 2, **measured(seconds, **psnr)}


BASE, SLOW, ALONE = (
    Variant(name="base"),
    Variant(name="slow", recipe={"loss": {"eikonal_weight": 0.3}}),
    Variant(name="alone", modalities=["ms"]),
)
ROWS = [
    row("base", 0, 10.0, rgb=30.0, ms=28.0),
    row("slow", 0, 12.0, rgb=31.0, ms=30.0),
    row("alone", 0, 10.0, ms=27.0),
    row("base", 1, 11.0, rgb=32.0, ms=29.0),
    row("slow", 1, 15.0, rgb=32.0, ms=32.0),
    row("alone", 1, 11.0, ms=25.0),
]


def test_differences_are_paired_by_seed() -> None:
    base, slow, alone = compare([BASE, SLOW, ALONE], ROWS)
    assert "difference" not in base and base["seeds"] == 2 and base["seconds"] == 10.5 and base["mean"]["psnr"] == 29.75
    assert slow["seconds"] == 13.5 and slow["mean"]["psnr"] == 31.25 and slow["changes"] == {"loss.eikonal_weight": 0.3}
    difference = slow["difference"]
    assert difference["seconds"] == {"mean": 3.0, "spread": pytest.approx(math.sqrt(2.0))}
    assert difference["psnr"] == {"mean": 1.5, "spread": pytest.approx(0.0)}  # (1 + 2) / 2 and (0 + 3) / 2
    assert difference["modalities"]["rgb"]["psnr"] == {"mean": 0.5, "spread": pytest.approx(math.sqrt(0.5))}
    assert difference["geometry"]["chamfer_visible"]["mean"] == 0.0
    # over the modality that both have, not mean against mean
    assert alone["mean"]["psnr"] == 26.0 and alone["difference"]["psnr"]["mean"] == -2.5


def test_one_seed_has_no_spread_and_a_half_done_bench_is_compared() -> None:
    base, slow = compare([BASE, SLOW, ALONE], ROWS[:2])
    assert slow["difference"]["psnr"] == {"mean": 1.5, "spread": None} and base["seeds"] == 1
    (only,) = compare([BASE, SLOW], ROWS[:1])
    assert only["name"] == "base"
    assert plot([only]).axes and tables_of([only])


def test_together_over_alone() -> None:
    tables = {table.title: table for table in tables_of(compare([BASE, SLOW, ALONE], ROWS))}
    rows = {(r["name"], r["modality"]): r for r in tables["Per modality"].rows}
    assert rows["alone", "ms"]["together"]["psnr"]["mean"] == 2.5
    assert "together" not in rows["slow", "ms"] and "together" not in rows["base", "rgb"]
    assert rows["slow", "rgb"]["difference"]["psnr"]["mean"] == 0.5
    cells = [column.cell(rows["alone", "ms"]) for column in tables["Per modality"].filled()]
    assert "+2.50 ± 2.12" in cells and "-2.50 ± 2.12" in cells


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    made: list[Job] = []

    def fake(job: Job, run: Path) -> dict[str, Any]:
        made.append(job)
        names = job.modalities or ("rgb", "ms")
        return measured(**{name: 20.0 + job.seed + job.recipe.loss.eikonal_weight for name in names})

    monkeypatch.setattr(jobs, "run_job", fake)
    return made


TABLE = """
[[variant]]
name = "base"
[[variant]]
name = "pull"
why = "a stronger pull | or so"
recipe = { loss.eikonal_weight = 0.6 }
[[variant]]
name = "alone"
modalities = ["multispectral"]
[[variant]]
name = "few"
frames = { pol = 2 }
"""


@pytest.fixture
def table(tmp_path: Path) -> str:
    (tmp_path / "table.toml").write_text(TABLE)
    return str(tmp_path / "table.toml")


def test_every_variant_with_every_seed_and_the_baseline_always(fits: list[Job], table: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    bench_ablation(EXAMPLE, table, out, steps=3, only=["pull"])
    assert [(job.name, job.steps, job.budget) for job in fits] == [("base-seed0", 3, None), ("pull-seed0", 3, None)]
    report = bench_ablation(EXAMPLE, table, out, steps=3, seeds=[0, 1])
    assert [job.name for job in fits[2:]] == ["alone-seed0", "few-seed0", "base-seed1", "pull-seed1", "alone-seed1", "few-seed1"]
    assert fits[2].modalities == ("ms",) and fits[3].frames == {"pol": 2}
    by_name = {variant["name"]: variant for variant in report.results["variants"]}
    assert by_name["pull"]["difference"]["psnr"] == {"mean": pytest.approx(0.5), "spread": pytest.approx(0.0)}
    text = (out / "report.md").read_text()
    for part in ("loss.eikonal_weight = 0.6", "a stronger pull \\| or so", "frames = {'pol': 2}", "+0.50 ± 0.00"):
        assert part in text
    assert (out / "plot.svg").is_file() and len(report.results["rows"]) == 8


def test_bad_requests_run_nothing(fits: list[Job], table: str, tmp_path: Path) -> None:
    requests: list[tuple[dict[str, Any], str]] = [
        ({"steps": 3, "budget": 2.0}, "either"),
        ({}, "either"),
        ({"steps": 3, "only": ["push"]}, "'push'.*base, pull, alone, few"),
        ({"steps": 3, "seeds": []}, "seeds"),
        ({"steps": 3, "seeds": [1, 1]}, "seeds"),
    ]
    for options, words in requests:
        with pytest.raises(InputError, match=words):
            bench_ablation(EXAMPLE, table, tmp_path / "out", **options)
    assert not fits and not (tmp_path / "out").exists()
