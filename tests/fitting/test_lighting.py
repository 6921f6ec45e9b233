"""Lamps that a fit looks for, tries and decides on."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from few_looks import few_looks

from mmsynth.field.storage import load_field
from mmsynth.fitting import candidates, lighting
from mmsynth.fitting.candidates import Look
from mmsynth.fitting.held_out import selections
from mmsynth.fitting.lighting import decide_light, keep_bright_lamps, look_for_lamps
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import fit
from mmsynth.fitting.schedule import sampling_at
from mmsynth.fitting.trainer import Trainer
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene

SMALL = Recipe().with_changes({
    "sampling.samples_per_step": 2048, "sampling.samples_growth": 1.0,
    "surface.levels": 3, "surface.max_rows_log2": 12, "radiance.levels": 3, "radiance.max_rows_log2": 12,
    "sampling.occupancy_resolution": 24, "poses.views": "off", "poses.rig": "off",
})  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(data_folder("example_scene"), modalities=["rgb", "pol"])


def _trainer(scene: Scene, light: str, steps: int = 40) -> Trainer:
    return Trainer(scene, SMALL.with_changes({"radiance.light": light}), steps, None, 0, "cpu")


def _ready(scene: Scene) -> tuple[Trainer, Any]:
    """A field with lamps, some steps on."""
    trainer = _trainer(scene, "on")
    while trainer.progress < 0.4:
        trainer.run_step()
    return trainer, sampling_at(0.4, trainer.recipe, trainer.needs)


def test_lamps_are_tried_and_then_decided_on(scene: Scene) -> None:
    trainer = _trainer(scene, "on")
    news = []
    for _ in range(40):
        trainer.run_step()
        news.append((trainer.state.light_looks, trainer.field.shines, trainer.state.light is not None))
    looks, shines, decided = (list(column) for column in zip(*news, strict=True))
    # at 0.3 of 40 steps, and at 0.45
    assert looks.index(1) == shines.index(True) == 12 and decided.index(True) == 18 and all(shines[12:])
    assert [looks.count(n) > 0 for n in range(4)] == [True] * 4 and looks.index(3) < 18 and looks == sorted(looks)
    assert trainer.choices["light"].value and "asked for by the recipe" in trainer.choices["light"].why
    light = trainer.field.light
    assert light is not None and all(p.grad is not None for p in light.parameters())


def test_without_light_nothing_is_built(scene: Scene, tmp_path: Path) -> None:
    field = fit(scene, tmp_path, recipe=SMALL.with_changes({"radiance.light": "off"}), steps=20)
    assert field.light is None and not field.design.light and not any(name.startswith("light.") for name in field.state_dict())
    assert field.manifest["needs"]["choices"]["light"]["value"] is False


def test_a_field_that_decided_against_lamps_forgets_them(scene: Scene, tmp_path: Path) -> None:
    """They must save more than everything: they cannot, and the run is that of a field without light."""
    recipe = SMALL.with_changes({"radiance.light_min_improvement": 1.0})
    field = fit(scene, tmp_path, recipe=recipe, steps=20)
    choice = field.manifest["needs"]["choices"]["light"]
    assert field.light is None and not choice["value"] and "100.0% asked for" in choice["why"]
    assert load_field(tmp_path).light is None


@pytest.mark.parametrize("stop", [10, 15, 30])  # before lamps are sought, in their trial, and after it
@pytest.mark.parametrize(("changes", "kept"), [({"radiance.light": "on"}, True), ({"radiance.light_min_improvement": 1.0}, False)])
def test_a_fit_resumes_to_the_same_lamps(
    scene: Scene, stop: int, changes: dict[str, Any], kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    few_looks(monkeypatch, rays=512)
    recipe = SMALL.with_changes(changes)
    first, second = (Trainer(scene, recipe, 40, None, 0, "cpu") for _ in range(2))
    for step in range(36):
        if step == stop:
            saved = copy.deepcopy(first.checkpoint())
        first.run_step()
    second.restore(saved)
    for _ in range(36 - stop):
        second.run_step()
    expected, found = first.field.state_dict(), second.field.state_dict()
    assert list(expected) == list(found) and all(torch.equal(expected[name], found[name]) for name in expected)
    assert first.state.light is not None and first.state.light.value == kept


def test_lamps_stand_beyond_the_cameras(scene: Scene) -> None:
    trainer, sampling = _ready(scene)
    light = trainer.field.light
    assert light is not None
    light.used[:] = False
    count = look_for_lamps(trainer.field, trainer.measurements, sampling, 0)
    assert count == light.count > 0
    cameras = np.concatenate([np.linalg.norm(m.origins, axis=1) for m in trainer.measurements.values()])
    assert float(light.position[:count].detach().norm(dim=1).min()) > float(np.median(cameras))


def test_lamps_that_nothing_mirrors_are_not_needed(scene: Scene) -> None:
    """A surface without strength, that polarizes nothing: the lamps save nothing, exactly."""
    trainer, sampling = _ready(scene)
    light = trainer.field.light
    assert light is not None
    with torch.no_grad():
        light.second.weight[1:4] = 0.0
        light.second.bias[1:4] = -200.0
    recipe = trainer.recipe.radiance.model_copy(update={"light": "auto", "light_min_improvement": 1e-6})
    choice = decide_light(trainer.field, trainer.measurements, selections(trainer.importance, None), recipe, trainer.needs, sampling, 0)
    assert not choice.value and "save 0.0%" in choice.why


def test_copies_side_by_side_learn_what_they_would_alone(
    scene: Scene, use_threads: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, sampling = _ready(scene)
    few_looks(monkeypatch, rays=512)
    found = []
    for threads in (1, 2):
        use_threads(threads)
        random = np.random.default_rng(0)
        looks = candidates.look_twice(trainer.field, trainer.measurements, selections(trainer.importance, None), sampling, random)
        copies = [(0, True), (3, True), (3, False)]
        found.append(candidates.errors_of_copies(trainer.field.shader, *looks, copies))
    for name, alone in found[0].items():
        assert torch.equal(alone, found[1][name]) and not torch.equal(alone[0], alone[1]) and not torch.equal(alone[1], alone[2])


def test_the_modality_that_lamps_save_most_of_decides(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the polarization's error, at the price of a tenth of rgb's: lamps stay, and by what it says."""
    trainer, sampling = _ready(scene)
    few_looks(monkeypatch, rays=512)

    def errors(shader: Any, learned: list[Look], judged: list[Look], degree: int, mirrors: bool) -> list[torch.Tensor]:
        out = [torch.full((len(seen.usable),), 1.1 if mirrors else 1.0) for seen in judged]
        for of_look, seen in zip(out, judged, strict=True):
            of_look[seen.batch.parts["pol"][1]] = 0.9 if mirrors else 1.0
        return out

    monkeypatch.setattr(candidates, "squared_errors", errors)
    recipe = trainer.recipe.radiance.model_copy(update={"light": "auto"})
    choice = decide_light(trainer.field, trainer.measurements, selections(trainer.importance, None), recipe, trainer.needs, sampling, 0)
    assert choice.value and "save 10.0% (±0.0%) of pol's error" in choice.why


def test_few_views_keep_lamps_that_surely_save_anything(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """What they cost is time, and few views run out before it does."""
    trainer, sampling = _ready(scene)
    few_looks(monkeypatch, rays=512)

    def decided(saved: float, spread: float, few: bool) -> bool:
        def errors(shader: Any, learned: list[Look], judged: list[Look], degree: int, mirrors: bool) -> list[torch.Tensor]:
            random = torch.Generator().manual_seed(0)
            noise = [spread * torch.randn(len(seen.usable), generator=random) for seen in judged]
            return [1.0 - saved + of_look - of_look.mean() if mirrors else torch.ones_like(of_look) for of_look in noise]

        monkeypatch.setattr(candidates, "squared_errors", errors)
        recipe, needs = trainer.recipe.radiance.model_copy(update={"light": "auto"}), replace(trainer.needs, few=few)
        selected = selections(trainer.importance, None)
        return decide_light(trainer.field, trainer.measurements, selected, recipe, needs, sampling, 0).value

    assert decided(0.01, 0.0, few=True) and not decided(0.01, 0.0, few=False)
    assert not decided(0.01, 10.0, few=True) and decided(0.03, 0.0, few=False)


def test_views_that_are_held_out_judge_lamps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial of the packaged scene: the copies of the shader learn from the other views."""
    scene = load_scene(data_folder("example_scene"), modalities=["rgb"])
    trainer, looks = Trainer(scene, SMALL.with_changes({"radiance.light": "on"}), 40, None, 0, "cpu"), list[list[Look]]()

    def spied(*args: Any) -> tuple[list[Look], list[Look]]:
        looks.extend(candidates.look_twice(*args))
        return looks[0], looks[1]

    monkeypatch.setattr(lighting, "look_twice", spied)
    while trainer.state.light is None:
        trainer.run_step()
    rgb = trainer.measurements["rgb"]
    views_of = lambda some: set(rgb.views[np.concatenate([seen.batch.frame.numpy() for seen in some])].tolist())
    learned, judged = map(views_of, looks)
    held = set(np.unique(rgb.views)[4::8].tolist())
    assert judged == held and learned == set(rgb.views.tolist()) - held


def test_a_lamp_of_which_nothing_is_seen_is_given_up(scene: Scene) -> None:
    trainer, sampling = _ready(scene)
    light = trainer.field.light
    assert light is not None and light.count > 1
    before = light.count
    lost = int(torch.nonzero(light.used)[0, 0])
    with torch.no_grad():
        light.log_spectrum[lost] = -20.0
    left = keep_bright_lamps(trainer.field, trainer.measurements, sampling, 0)
    assert 0 < left < before and left == light.count and not light.used[lost]
    assert light.lamps().position.shape == (left, 3)
    trainer.run_step()  # the fit goes on with the others
    assert trainer.state.bad_steps == 0
    while light.count > 1:
        light.used[torch.nonzero(light.used)[0, 0]] = False
    assert keep_bright_lamps(trainer.field, trainer.measurements, sampling, 0) == 1  # the last one stays: the decision is about it
