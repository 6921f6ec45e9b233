"""``bench render``: every way to render is there, and its error is that of sampling, against a rendering that is finer than all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import look_at, ring

from mmsynth.bench import render as bench
from mmsynth.bench.render import FAMILIES, Rays, bench_render, difference, fine, rays_of, truth_of
from mmsynth.errors import InputError
from mmsynth.field.design import Design
from mmsynth.field.field import Field
from mmsynth.field.kernels import Sampling
from mmsynth.scene.scene import Frame, Region, Scene, Sensor, Split
from mmsynth.sensors.camera import Camera

CAMERA = Camera(24, 18, 30.0, 30.0, 11.5, 8.5)
SENSORS = {
    "rgb": Sensor("rgb", ("R", "G", "B"), (None,) * 3),
    "pol": Sensor("pol", ("0", "45", "90", "135"), (None,) * 4, None, (0.0, 45.0, 90.0, 135.0)),
}


@pytest.fixture(scope="module")
def field() -> Field:
    """A rough ball, soft enough that rays pass its rim, with features that change within a step."""
    design = Design(
        surface_levels=2, radiance_levels=2, surface_rows_log2=10, radiance_rows_log2=10, surface_finest=8, radiance_finest=32,
        surface_hidden=8, radiance_hidden=16, coarsest=4, occupancy=16,
    )  # fmt: skip
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        field = Field(design, dict(SENSORS), {"rgb": 0.5, "pol": 0.25}, Region((1.0, 2.0, 3.0), 2.0), cameras={"rgb": CAMERA})
        with torch.no_grad():
            field.surface.output_weight.normal_(0, 0.05)
            field.appearance.table.normal_()
    field.sampling = Sampling(20.0, 0.06, 2, 2)
    return field


@pytest.fixture(scope="module")
def scene(field: Field) -> Scene:
    centre = np.array(field.region.centre)
    frames = [Frame("rgb", i, Path("none"), CAMERA, look_at(centre + 2.0 * np.asarray(p)[:3, 3], centre)) for i, p in enumerate(ring(6))]
    return Scene(Path("none"), "test", dict(SENSORS), tuple(frames), field.region, Split(tuple(range(5)), (5,), "test"))


@pytest.fixture(scope="module")
def results(field: Field, scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    report = bench_render(field, scene, tmp_path_factory.mktemp("render"), threads=1, repeats=1)
    assert len(report.tables) == len(FAMILIES) and (report.out / "plot.svg").stat().st_size > 1000
    assert field.sampling == Sampling(20.0, 0.06, 2, 2)
    return report.results


def _of(results: dict[str, Any], family: str, method: str, problem: str = "") -> list[dict[str, Any]]:
    found = [r for r in results["rows"] if r["family"] == family and method in r["method"] and problem in r["problem"]]
    assert found and all(row["rays_per_s"] > 0 and row["ns"] == pytest.approx(1e9 / row["rays_per_s"]) for row in found)
    return found


def test_rows_are_there_for_one_modality_and_for_all(results: dict[str, Any]) -> None:
    assert {row["family"] for row in results["rows"]} == {family.__name__ for family in FAMILIES}
    for family in ("termination", "steps", "tiles", "threads"):
        assert {row["problem"] for row in _of(results, family, "")} == {"rgb", "all 2"}
    assert [r["method"] for r in _of(results, "termination", "", "rgb")] == [
        f"max_optical_depth {v}" for v in ("1", "2", "3 (the field's)", "5", "8")
    ]
    asked = {row["method"]: row for row in _of(results, "asked", "")}
    assert set(asked) == {"rgb", "rgb, normals", "pol", "pol, normals", "all 2", "all 2, normals", "depth", "depth, normals"}
    assert "error" not in asked["depth"] and asked["depth, normals"]["normal"] < 5.0
    assert results["rays"] == 4 * 24 * 18


@pytest.mark.parametrize("problem", ["rgb", "all 2"])
def test_error_falls_with_finer_sampling(results: dict[str, Any], problem: str) -> None:
    steps = _of(results, "steps", "step x", problem)
    for key, worst in (("error", 4), ("depth", 3)):  # steps longer than the surface is thick meet it by chance
        values = [row[key] for row in steps[:worst]]
        assert values == sorted(values) and values[0] < 0.3 * values[-1], key
    samples = [row["samples"] for row in steps]
    assert samples == sorted(samples, reverse=True) and results["reference"]["samples"] > 2 * samples[0]
    ends = _of(results, "termination", "max_optical_depth", problem)
    assert [row["samples"] for row in ends] == sorted(row["samples"] for row in ends)
    assert ends[0]["error"] > 2 * ends[2]["error"]
    assert 0 < results["reference"]["truth_error"] < 0.5 * steps[0]["error"]


def test_tiles_and_threads_change_nothing(results: dict[str, Any]) -> None:
    own = _of(results, "steps", "step x 1 ", "rgb")[0]["error"]
    for row in (*_of(results, "tiles", "rays", "rgb"), *_of(results, "threads", "threads", "rgb")):
        assert row["error"] == pytest.approx(own, rel=1e-3)


def test_errors_are_differences_from_the_reference(field: Field, scene: Scene, results: dict[str, Any]) -> None:
    rays = rays_of(field, scene)
    truth = truth_of(field, rays).outputs
    seen = field.render_rays(rays.origins, rays.directions, rays.camera_x, list(SENSORS), True)
    for names, problem in ((["rgb"], "rgb"), (list(SENSORS), "all 2")):
        found = difference(seen, truth, names)
        row = _of(results, "steps", "step x 1 ", problem)[0]
        assert {key: row[key] for key in found} == pytest.approx(found, rel=1e-3)
    # rays of the scene's own views, as Field.render casts them
    frame = scene.frames[0]
    np.testing.assert_allclose(
        field.render(CAMERA, frame.camera_to_world).channels["rgb"].reshape(-1, 3), seen["rgb"][: 24 * 18], atol=1e-6
    )
    # one number that is off by a half
    off = {name: value.clone() for name, value in truth.items()}
    off["rgb"][7, 1] += 0.5
    found = difference(off, truth, ["rgb"])
    assert found["worst"] == pytest.approx(0.5) and found["error"] == pytest.approx(0.5 / truth["rgb"].numel() ** 0.5)


def test_the_reference_is_what_the_kernel_nears_and_is_not_cut_off(field: Field, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """By other code than the kernel that is timed, which has room for few samples a ray."""
    some = rays_of(field, scene)
    rays = Rays(*next(some.tiles(24 * 18)))
    truth = truth_of(field, rays)
    fused = field.sampling
    try:
        field.sampling = fine(fused)
        found = field.render_rays(rays.origins, rays.directions, rays.camera_x, list(SENSORS), True)
    finally:
        field.sampling = fused
    assert truth.samples < 96 and difference(found, truth.outputs, list(SENSORS))["error"] < 1e-4
    long = fused._replace(step=fused.step / 8)
    field.sampling = long
    try:
        assert truth_of(field, rays).samples > truth.samples
        monkeypatch.setattr(bench, "_FINE_MOST", 8)
        assert truth_of(field, rays).samples <= 8
    finally:
        field.sampling = fused


def test_bad_requests_are_refused(field: Field, scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="bench render: no family 'speed', expected some of termination"):
        bench_render(field, scene, tmp_path, only=["speed"])
    with pytest.raises(InputError, match="no frame of rgb"):
        bench_render(field, replace(scene, frames=()), tmp_path)
    assert not list(tmp_path.iterdir())
