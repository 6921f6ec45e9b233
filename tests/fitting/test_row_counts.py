"""Hash tables get the rows that the surface asks for, in the middle of a fit, and nothing else changes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mmsynth.field.design import Design
from mmsynth.field.encoding import HashGrid
from mmsynth.field.field import Field
from mmsynth.field.storage import load_field
from mmsynth.fitting.measurements import load_measurements
from mmsynth.fitting.needs import assess
from mmsynth.fitting.progress import FitProgress
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import fit
from mmsynth.fitting.schedule import sampling_at
from mmsynth.fitting.table_sizes import cells_at_surface, rows_log2, size_tables
from mmsynth.fitting.trainer import Trainer
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Region, Scene, Sensor

SMALL: dict[str, Any] = {
    "sampling.samples_per_step": 2048, "sampling.samples_growth": 1.0,
    "sampling.initial_rays": 128, "surface.levels": 4, "radiance.levels": 4,
    "sampling.occupancy_resolution": 24, "sampling.occupancy_every": 4, "loss.eikonal_points": 64, "radiance.hidden_width": 32,
    "surface.max_rows_log2": 16, "radiance.max_rows_log2": 17, "radiance.cells_per_pixel": 30.0, "surface.cells_per_row": 2.0,
    "radiance.cells_per_row": 2.0, "surface.rays_per_row": 0.002, "radiance.rays_per_row": 1e-3, "schedule.tables_at": 0.125,
    "schedule.levels_until": 0.5, "poses.views": "off", "poses.rig": "off", "radiance.light": "off",
    "schedule.ema_fraction": 0.25, "radiance.view_dependence": 1,
    "radiance.exposure": "off",
}  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(data_folder("example_scene"), modalities=["rgb", "nir"])


def _ball(radius: float, **sizes: Any) -> Field:
    """A new field: exactly a ball."""
    design = Design(**{"surface_levels": 3, "radiance_levels": 3, "occupancy": 48, "initial_radius": radius, **sizes})
    field = Field(design, {"grey": Sensor("grey", ("L",), (None,))}, {"grey": 1.0}, Region((0.0, 0.0, 0.0), 1.0))
    field.occupancy.update(lambda x: field.surface(x, 3), 60.0)
    return field


def _crossed(radius: float, across: int) -> int:
    """Cells of [-1, 1]³ with corners inside the ball and outside of it, all looked at."""
    axis = np.linspace(-1.0, 1.0, across + 1)
    inside = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2 < radius**2
    corners = [inside[i : across + i, j : across + j, k : across + k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return int((np.any(corners, 0) & ~np.all(corners, 0)).sum())


@pytest.mark.parametrize("radius", [0.2, 0.5, 0.8])
def test_the_count_is_that_of_cells_with_corners_on_both_sides(radius: float) -> None:
    field = _ball(radius, surface_finest=64, radiance_finest=160)
    surface, radiance = cells_at_surface(field, 3, torch.Generator().manual_seed(0))
    assert surface == pytest.approx(_crossed(radius, 64), rel=0.05)
    assert radiance == pytest.approx(_crossed(radius, 160), rel=0.05)


def test_rows_stay_within_what_is_sensible_and_the_recipe_allows() -> None:
    assert rows_log2(2.0**15, 19) == 15
    assert rows_log2(2.0**15 * 1.4, 19) == 15 and rows_log2(2.0**15 * 1.5, 19) == 16  # the nearest
    assert rows_log2(0.0, 19) == 12 and rows_log2(1e12, 19) == 19
    assert rows_log2(1e12, 9) == rows_log2(0.0, 9) == 9  # a recipe may ask for less


def test_a_short_fit_has_fewer_rows(scene: Scene) -> None:
    """50 rays for a row of the radiance, 100 for one of the surface, 1638 rays a step."""
    recipe = Recipe().with_changes(
        {**SMALL, "surface.rays_per_row": 100.0, "radiance.rays_per_row": 50.0, "sampling.samples_per_step": 16384}
    )
    designs = {steps: Trainer(scene, recipe, steps, None, 0, "cpu").field.design for steps in (100, 2000, 8000)}
    assert [d.radiance_rows_log2 for d in designs.values()] == [12, 16, 17]
    assert [d.surface_rows_log2 for d in designs.values()] == [12, 15, 16]


def test_rows_follow_the_rays_of_a_fit(scene: Scene) -> None:
    """A minute of two cores, two, five and ten; hours."""
    measurements = load_measurements(scene)

    def rows(rays: float, **changes: int) -> tuple[Any, Any]:
        recipe = Recipe().with_changes({f"{grid}.max_rows_log2": most for grid, most in changes.items()})
        design = assess(scene, measurements, recipe, 0, rays).design
        return design.surface_rows_log2, design.radiance_rows_log2

    assert [rows(rays) for rays in (4.2e6, 8.4e6, 2.1e7, 4.2e7, 1e12)] == [(15, 16), (16, 17), (17, 18), (18, 19), (19, 20)]
    assert rows(1e12, surface=14, radiance=18) == (14, 18)


@settings(max_examples=30, deadline=None)
@given(levels=st.integers(1, 5), share=st.floats(0, 1), before=st.integers(6, 12), after=st.integers(6, 12), finer=st.integers(1, 6))
def test_other_rows_for_finer_levels_leave_the_coarser_as_they_are(levels: int, share: float, before: int, after: int, finer: int) -> None:
    first = round(share * levels)
    grid = HashGrid(levels, before, 4, 4 * finer)
    grid.table.data.normal_()
    x = torch.rand(200, 3) * 2 - 1
    values, everything, table = grid(x, first).detach(), grid(x, levels).detach(), grid.table
    rows = [before] * first + [after] * (levels - first)
    kept = grid.resize(first, rows, torch.Generator().manual_seed(0))
    assert grid.table is table and torch.equal(grid(x, first).detach(), values)
    if kept == len(grid.table):  # nothing has another size
        assert torch.equal(grid(x, levels).detach(), everything)
    else:
        assert grid.table[kept:].abs().max() <= 1e-4
    expected = HashGrid(levels, rows, 4, 4 * finer)
    assert torch.equal(grid.offsets, expected.offsets) and grid.table.shape == expected.table.shape


def test_levels_in_use_keep_their_rows() -> None:
    with pytest.raises(ValueError, match="before level 2"):
        HashGrid(3, 10, 16, 64).resize(2, [12, 10, 9], torch.Generator())


def test_a_fit_sizes_its_finer_levels_once_and_says_so(scene: Scene) -> None:
    trainer = Trainer(scene, Recipe().with_changes(SMALL), 16, None, 0, "cpu")
    assert trainer.field.design.surface_rows_log2 == 16 and trainer.field.design.radiance_rows_log2 == 17
    assert "tables" not in trainer.choices
    while trainer.progress < 0.125:
        trainer.run_step()
    coarse = int(trainer.field.appearance.offsets[2])
    before, moments = trainer.field.appearance.table.detach().clone(), trainer.optimiser.moments["appearance.table"][0].clone()
    sampling, generator = sampling_at(trainer.progress, trainer.recipe, trainer.needs), torch.Generator().manual_seed(0)
    trainer.state.tables = size_tables(trainer.field, trainer.recipe, sampling, generator)
    trainer._resize_tables(trainer.state.tables, generator)
    design, evidence = trainer.field.design, trainer.choices["tables"].why
    assert isinstance(design.radiance_rows_log2, tuple) and design.radiance_rows_log2[:2] == (17, 17)
    fine = design.radiance_rows_log2[-1]
    assert 12 <= fine < 17 and f"radiance 2^{fine} for" in evidence and "no more" not in evidence.split("radiance")[1]
    table = trainer.field.appearance.table
    assert torch.equal(table[:coarse], before[:coarse]) and len(table) == int(trainer.field.appearance.offsets[-1]) < len(before)
    assert torch.equal(trainer.optimiser.moments["appearance.table"][0][:coarse], moments[:coarse]) and moments[:coarse].any()
    while trainer.progress < 1:
        trainer.run_step()
    assert trainer.field.design == design and not torch.equal(trainer.field.appearance.table[:coarse], before[:coarse])
    assert trainer.optimiser.moments["appearance.table"][1][coarse:].any()  # the finer levels learn
    assert trainer.state.bad_steps == 0


def test_a_small_object_gets_smaller_tables_than_a_large_one(scene: Scene) -> None:
    rows = {}
    for radius in (0.1, 0.6):
        recipe = Recipe().with_changes(
            {**SMALL, "surface.initial_radius": radius, "schedule.learning_rate_grid": 1e-9, "schedule.learning_rate_network": 1e-9}
        )
        trainer = Trainer(scene, recipe, 16, None, 0, "cpu")  # what it starts from is what it keeps
        while trainer.state.tables is None:
            trainer.run_step()
        rows[radius] = trainer.field.design
    assert rows[0.1].radiance_rows_log2[-1] < rows[0.6].radiance_rows_log2[-1]


def test_no_counting_gives_the_most_from_the_start(scene: Scene) -> None:
    trainer = Trainer(scene, Recipe().with_changes({**SMALL, "schedule.tables_at": 0.0}), 8, None, 0, "cpu")
    assert trainer.field.design.surface_rows_log2 == 16 and trainer.field.design.radiance_rows_log2 == 17
    assert "asked for by the recipe" in trainer.choices["tables"].why
    design = trainer.field.design
    while trainer.progress < 1:
        trainer.run_step()
    assert trainer.field.design == design and trainer.state.tables is None


@pytest.mark.parametrize("killed_at", [3, 9])
def test_a_fit_killed_before_or_after_the_count_becomes_the_same(scene: Scene, tmp_path: Path, killed_at: int) -> None:
    recipe = Recipe().with_changes(SMALL)
    whole = fit(scene, tmp_path / "whole", recipe=recipe, steps=16)

    def kill(news: FitProgress) -> None:
        if news.step == killed_at:
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        fit(scene, tmp_path / "cut", recipe=recipe, steps=16, checkpoint_every=0.0, on_step=kill)
    resumed = fit(scene, tmp_path / "cut", recipe=recipe, resume=True)
    assert resumed.design == whole.design and resumed.manifest["needs"]["choices"] == whole.manifest["needs"]["choices"]
    for name, value in whole.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], value), name
    loaded = load_field(tmp_path / "cut")
    assert loaded.design == whole.design and torch.equal(loaded.surface.grid.table, whole.surface.grid.table)
