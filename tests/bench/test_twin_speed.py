"""``bench twin``: every effect is there and keeps its closed form, and the trade-offs go the way they must."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mmsynth.bench.twin import FAMILIES, bench_twin
from mmsynth.errors import InputError
from mmsynth.field.design import Design
from mmsynth.field.field import Field
from mmsynth.scene.scene import Region, Sensor
from mmsynth.sensors.camera import Camera


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    sensors = {"mono": Sensor("mono", ("mono",), (None,))}
    design = Design(surface_levels=2, radiance_levels=2, surface_finest=8, radiance_finest=8, coarsest=4, occupancy=16)
    field = Field(design, sensors, {"mono": 0.5}, Region((0.0, 0.0, 0.0), 1.0), cameras={"mono": Camera(24, 18, 30.0, 30.0, 11.5, 8.5)})
    report = bench_twin(tmp_path_factory.mktemp("twin"), field, repeats=0)
    assert len(report.tables) == len(FAMILIES) + 1 and (report.out / "plot.svg").stat().st_size > 1000
    return report.results["rows"]


def _of(rows: list[dict[str, Any]], family: str, problem: str = "") -> list[dict[str, Any]]:
    found = [row for row in rows if row["family"] == family and problem in row["problem"]]
    assert found and all(row["ns"] > 0 for row in found)
    return found


@pytest.mark.parametrize("family", ["effects", "optics"])
def test_effects_keep_their_closed_forms(rows: list[dict[str, Any]], family: str) -> None:
    assert all(row["deviations"] < 4 for row in _of(rows, family))


@pytest.mark.parametrize("family", ["supersampling", "of the field"])
def test_more_rays_are_closer_to_the_mean_over_the_pixel(rows: list[dict[str, Any]], family: str) -> None:
    errors = [row["error"] for row in _of(rows, family)]
    assert errors == sorted(errors, reverse=True) and errors[0] > 3 * errors[3]


def test_calibration_gets_better_with_frames_and_with_short_exposures(rows: list[dict[str, Any]]) -> None:
    """And the read noise, given the truth, is as far off as it must be."""
    one, four, quarter, sixteenth = _of(rows, "calibration", "truth")
    assert four["gain"] < 0.01 < one["gain"] and four["prnu"] < 0.05
    assert (
        one["read_at_best"] > 2.0 * four["read_at_best"] > 4.0 * quarter["read_at_best"] > 4.0 * sixteenth["read_at_best"]
        and sixteenth["read"] < 0.05
    )
    assert all(row["read"] < 4.0 * row["read_at_best"] for row in (one, four, quarter, sixteenth))
    *_, of_model = _of(rows, "calibration", "model")
    assert of_model["gain"] < 0.1 and of_model["read"] < 0.25


def test_errors_of_virtual_channels_are_as_expected(rows: list[dict[str, Any]]) -> None:
    for row in _of(rows, "spectra"):
        assert row["error"] == pytest.approx(row["expected_error"], rel=0.1)


def test_an_unknown_family_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="bench twin: no family 'blur', expected some of effects"):
        bench_twin(tmp_path, only=["blur"])
