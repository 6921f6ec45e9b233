"""``bench numerics``: every method is there, ours keep their bounds, and the usual ones fail where they are known to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mmsynth.bench.numerics import FAMILIES, bench_numerics
from mmsynth.errors import InputError


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    report = bench_numerics(tmp_path_factory.mktemp("numerics"), repeats=0)
    assert len(report.tables) == len(FAMILIES) and (report.out / "plot.svg").stat().st_size > 1000
    return report.results["rows"]


def _of(rows: list[dict[str, Any]], family: str, method: str) -> list[dict[str, Any]]:
    found = [row for row in rows if row["family"] == family and method in row["method"]]
    assert found
    return found


def test_every_row_has_a_time_and_an_error(rows: list[dict[str, Any]]) -> None:
    assert {row["family"] for row in rows} == {family.__name__ for family in FAMILIES}
    assert all(row["ns"] > 0 and row["worst"] >= 0 for row in rows)


def test_undistortion(rows: list[dict[str, Any]]) -> None:
    ours, usual = _of(rows, "undistortion", "mmsynth"), _of(rows, "undistortion", "OpenCV, 5")
    assert all(row["worst"] < 1e-3 and row["wrong"] == 0 for row in ours)
    assert ours[0]["missing"] == 0 and ours[-1]["missing"] > 0.3  # the last lens folds within the picture
    assert usual[0]["worst"] < 0.1 and all(row["wrong"] > 0.3 for row in usual[1:])
    assert all(row["missing"] == 0 for row in usual)  # it never says that there is no ray


def test_opacity(rows: list[dict[str, Any]]) -> None:
    assert all(row["worst"] < 2e-5 for row in _of(rows, "opacity", "mmsynth, float32"))
    haze = [row["error"] for row in _of(rows, "opacity", "NeuS, 1e-5, float32") if "empty" in row["problem"]]
    assert min(haze) > 1e-4
    assert max(row["error"] for row in _of(rows, "opacity", "NeuS, 1e-5, float32")) > 0.1


def test_normals_angles_and_resampling(rows: list[dict[str, Any]]) -> None:
    assert all(row["error"] < 1.0 for row in _of(rows, "normals", "float32 (mmsynth)"))
    assert max(row["error"] for row in _of(rows, "normals", "bfloat16")) > 10
    assert all(row["worst"] < 1e-4 for row in _of(rows, "angles", "mmsynth")) and _of(rows, "angles", "acos")[0]["error"] > 0.05
    for ours, usual in zip(_of(rows, "resampling", "mmsynth"), _of(rows, "resampling", "of angles"), strict=True):
        assert ours["worst"] < 0.5 and usual["worst"] > 30


def test_demosaicking(rows: list[dict[str, Any]]) -> None:
    (ours,), (edges,) = _of(rows, "demosaicking", "OpenCV, bilinear"), _of(rows, "demosaicking", "edge-aware")
    plain = next(row for row in _of(rows, "demosaicking", "normalised") if row["problem"] == "Bayer")
    assert plain["psnr"] == pytest.approx(ours["psnr"], abs=0.05) and edges["psnr"] > plain["psnr"]
    assert all(row["error"] > 0.005 for row in rows if row["problem"].startswith("false DoLP"))  # why raw frames are learned from


def test_unknown_families_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no family 'magic'"):
        bench_numerics(tmp_path, ["magic"])
