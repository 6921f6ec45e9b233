"""Hard cases of a fit: numbers that are not finite, a killed run, sharpness, grids that must open again."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from small_scenes import QUICK, around, write_scene

from mmsynth.errors import InputError
from mmsynth.field.kernels import OUTSIDE, SHELL
from mmsynth.fitting import trainer as trainer_module
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.schedule import sampling_at
from mmsynth.fitting.trainer import Trainer, fit
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene

Row = Callable[[str, str, str], None]


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return load_scene(write_scene(tmp_path / "scene", {"rgb": around(6)}))


def _trainer(scene: Scene, steps: int = 40, **changes: object) -> Trainer:
    return Trainer(scene, Recipe.model_validate({**QUICK.model_dump(), **changes}), steps, None, 0, "cpu")


def test_one_bad_pixel_spoils_one_step(row: Row, scene: Scene) -> None:
    """A value that turned NaN in memory: steps that meet it change nothing, all others go on."""
    trainer = _trainer(scene)
    rgb = trainer.measurements["rgb"]
    rgb.values = rgb.values.astype("float32") / 65535
    rgb.values[rgb.starts[0] + 40] = math.nan
    skipped = 0
    while trainer.progress < 1:
        before = {n: p.detach().clone() for n, p in trainer.field.named_parameters()}
        bad = trainer.state.bad_steps
        trainer.run_step()
        if trainer.state.bad_steps > bad:
            skipped += 1
            assert all(torch.equal(p, before[n]) for n, p in trainer.field.named_parameters())
    assert 0 < skipped < 20 and all(torch.isfinite(p).all() for p in trainer.field.parameters())
    row(
        "a pixel that is NaN, 40 steps",
        "every weight NaN after the first of them",
        f"{skipped} steps skipped and counted, all weights finite",
    )


def test_nothing_but_bad_steps_is_given_up(row: Row, scene: Scene) -> None:
    trainer = _trainer(scene)
    with torch.no_grad():
        trainer.field.appearance.table.fill_(math.inf)
    with pytest.raises(InputError, match="not finite in 20 steps"):
        while trainer.progress < 1:
            trainer.run_step()
    assert trainer.state.step == 20
    row("a fit that has diverged", "nan_to_num: it goes on learning nothing", "given up after 20 steps, in one sentence")


def test_a_killed_fit_goes_on_as_if_it_had_not_been(row: Row, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed where levels open, tables are sized, directions are decided."""
    recipe = Recipe.model_validate({**QUICK.model_dump(), "poses": "on"})
    whole = fit(scene, tmp_path / "whole", recipe, steps=40)
    monkeypatch.setattr(trainer_module, "CHECKPOINT_SECONDS", 0.0)
    for at in (1, 3, 13, 25, 39):

        def kill(news: trainer_module.Progress, at: int = at) -> None:
            if news.step == at:
                raise RuntimeError("killed")

        with pytest.raises(RuntimeError, match="killed"):
            fit(scene, tmp_path / f"cut{at}", recipe, steps=40, on_step=kill)
        resumed = fit(scene, tmp_path / f"cut{at}", recipe, resume=True)
        assert all(torch.equal(a, b) for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True)), at
    row(
        "killed after 1, 3, 13, 25, 39 of 40 steps and resumed",
        "NaN or another result: schedule, grid or random state lost",
        "the same field to the last bit",
    )


def test_the_sharpness_is_never_stuck_and_never_outruns_the_samples(row: Row, scene: Scene) -> None:
    """s times the step between samples stays in [0.5, 50], and grows by a schedule and not by a gradient."""
    trainer = _trainer(scene)
    s, widths = [], []
    for i in range(101):
        sampling = sampling_at(i / 100, trainer.recipe, trainer.needs)
        s.append(sampling.sharpness)
        widths.append(sampling.sharpness * sampling.step)
    assert s == sorted(s) and s[-1] > s[0]
    assert 0.5 <= min(widths) and max(widths) <= 50
    row(
        "sharpness over a fit",
        "learned: stuck at its start, or exploding",
        f"{s[0]:.0f} to {s[-1]:.0f}; s times the step from {min(widths):.1f} to {max(widths):.1f}",
    )


@pytest.mark.parametrize("state", [OUTSIDE, 200])
def test_a_grid_that_was_emptied_finds_the_scene_again(row: Row, scene: Scene, state: int) -> None:
    trainer = _trainer(scene, 60, occupancy_every=2)
    trainer.run_step()
    trainer.field.occupancy.states.fill_(state)
    while trainer.progress < 1:
        trainer.run_step()
    assert (trainer.field.occupancy.states == SHELL).any() and trainer.state.samples_total > 10_000 and trainer.state.bad_steps == 0
    row(
        f"an occupancy grid set to {'empty' if state == OUTSIDE else 'far from everything'}",
        "0 samples: aborts, or a white picture",
        "opens again within some steps",
    )
