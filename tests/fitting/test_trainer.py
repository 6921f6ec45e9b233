"""The trainer on the packaged example scene, a few steps at a time."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from conftest import ring

from mmsynth.errors import DivergedError, InputError, Interrupted
from mmsynth.field import kernels
from mmsynth.field.field import Field
from mmsynth.field.kernels import SHELL
from mmsynth.field.rendering import interval
from mmsynth.field.storage import load_field
from mmsynth.field.warmup import warm_up
from mmsynth.fitting import run as run_module
from mmsynth.fitting.ahead import DrawnStep, drawn_step
from mmsynth.fitting.checkpoint import read_checkpoint
from mmsynth.fitting.device import pick_device
from mmsynth.fitting.measurements import draw, load_measurements
from mmsynth.fitting.needs import assess
from mmsynth.fitting.progress import FitProgress
from mmsynth.fitting.recipe import Recipe, load_recipe
from mmsynth.fitting.run import fit
from mmsynth.fitting.schedule import learning_rate_factor, samples_of_step, sampling_at
from mmsynth.fitting.terms import eikonal
from mmsynth.fitting.trainer import Trainer
from mmsynth.operations.evaluation.evaluate import evaluate
from mmsynth.packaged import data_folder
from mmsynth.scene.images import load_frame
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Frame, Region, Scene, Sensor, Split, rig_of
from mmsynth.sensors.camera import Camera, ray_map, resized

pytestmark = pytest.mark.usefixtures("decided_by_few_rays")

# every number that a result here depends on: the defaults are tuned from time to time
SMALL = Recipe().with_changes({
    "sampling.samples_per_step": 2048, "sampling.samples_growth": 4.0, "sampling.initial_rays": 128, "sampling.evenly": 0.5,
    "surface.levels": 4, "surface.max_rows_log2": 12,
    "radiance.levels": 4, "radiance.max_rows_log2": 12, "surface.cells_per_pixel": 0.5, "radiance.cells_per_pixel": 1.0,
    "surface.hidden_width": 32, "radiance.hidden_width": 64, "sampling.occupancy_resolution": 24, "sampling.occupancy_every": 16,
    "surface.initial_radius": 0.3, "surface.outer_radius": 1.8, "schedule.sharpness_start": 20.0, "schedule.sharpness_per_footprint": 4.0,
    "schedule.sharpness_until": 0.6, "sampling.step_width": 2.0, "sampling.sphere_step_factor": 0.7, "sampling.min_slope": 0.5,
    "sampling.min_section_weight": 0.01, "sampling.max_optical_depth": 3.0, "schedule.levels_until": 0.4,
    "schedule.view_dependence_from": 0.3, "schedule.decide_at": 0.6, "radiance.view_dependence": 2, "radiance.exposure": "off",
    "radiance.light": "off",
    "surface.measurements_per_cell": 1e-3, "schedule.full_rate_sharpness": 200.0, "schedule.full_rate_sharpness_table": 800.0,
    "schedule.learning_rate_grid": 2e-2, "schedule.learning_rate_network": 8e-3,
    "schedule.learning_rate_end_factor": 0.1, "schedule.ema_fraction": 0.05,
    "loss.eikonal_weight": 0.05, "loss.eikonal_points": 128, "loss.background_opacity_weight": 0.02, "loss.alpha_weight": 0.5,
})  # fmt: skip


def _recipe(**changes: Any) -> Recipe:
    return SMALL.with_changes(changes)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(data_folder("example_scene"))


def _trainer(scene: Scene, steps: int = 10, **changes: Any) -> Trainer:
    return Trainer(scene, _recipe(**changes), steps, None, 0, "cpu")


def _tensors(field: Field) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in field.state_dict().items()}


Picture = Callable[[Camera, np.ndarray], np.ndarray]


def disc(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """White, of half the picture's width, on black."""
    v, u = np.mgrid[:18, :24]
    return np.repeat(0.8 * (np.hypot(u - 11.5, v - 8.5) < 5)[..., None], 3, -1)


def transparent_disc(camera: Camera, pose: np.ndarray) -> np.ndarray:
    return np.concatenate([np.full((18, 24, 3), 0.8), disc(camera, pose)[..., :1] / 0.8], -1)


def _ball_scene(folder: Path, picture: Picture, views: int = 6) -> Scene:
    """Views of 18 by 24 pixels from around; the last tests."""
    sensor, camera, frames = Sensor("rgb", ("R", "G", "B"), (None,) * 3), Camera(24, 18, 25.0, 25.0, 11.5, 8.5), []
    for view, pose in enumerate(ring(views)):
        np.save(folder / f"{view}.npy", picture(camera, pose).astype(np.float32))
        frames.append(Frame("rgb", view, folder / f"{view}.npy", camera, pose))
    split = Split(tuple(range(views - 1)), (views - 1,), "test")
    return Scene(folder, "test", {"rgb": sensor}, tuple(frames), Region((0.0, 0.0, 0.0), 1.0), split)


# --- a fit and its run


def test_a_fit_learns_and_its_run_gives_the_same_field_back(scene: Scene, tmp_path: Path) -> None:
    field = fit(scene, tmp_path / "run", recipe=SMALL, steps=300)
    assert set(field.sensors) == {"rgb", "nir", "mono", "pol", "ms"}
    for name, scores in evaluate(field, scene)["modalities"].items():
        raw = np.concatenate([load_frame(field.sensors[name], f)[0].ravel() for f in scene.frames_of(name, scene.split.test)])
        assert scores["psnr"] > -10 * np.log10(raw.var()) + 2, name  # 2 dB above the best flat picture
    again = load_field(tmp_path / "run")
    frame = scene.frames_of("rgb", scene.split.test)[0]
    a, b = (f.render(frame.camera, frame.camera_to_world, ["rgb", "pol"]) for f in (field, again))
    np.testing.assert_array_equal(a.channels["rgb"], b.channels["rgb"])
    np.testing.assert_array_equal(a.stokes["pol"], b.stokes["pol"])
    np.testing.assert_array_equal(a.depth_ray, b.depth_ray)
    assert a.channels["rgb"].shape == (frame.camera.height, frame.camera.width, 3)
    hit = np.isfinite(a.depth_z)
    assert hit.any() and (a.depth_ray[hit] >= a.depth_z[hit]).all()
    np.testing.assert_allclose(np.linalg.norm(a.normal[hit], axis=-1), 1.0, atol=1e-5)
    assert field.manifest["skipped_steps"] == 0 and field.manifest["steps"] == 300


def test_a_fit_with_a_background_learns_too(tmp_path: Path) -> None:
    """A sky whose colour is that of the direction, and a grey ball before it."""

    def picture(camera: Camera, pose: np.ndarray) -> np.ndarray:
        d = ray_map(camera)[0] @ pose[:3, :3].T
        b = d @ pose[:3, 3]
        hit = b**2 - pose[:3, 3] @ pose[:3, 3] + 0.5**2 > 0
        return np.where(hit[..., None], 0.7, 0.5 + 0.4 * d)

    scene = _ball_scene(tmp_path, picture, 24)
    field = fit(scene, tmp_path / "run", recipe=_recipe(**{"surface.background": "on"}), steps=600)
    assert field.design.background and field.surface.grid.extent == 2.0
    (frame,) = scene.frames_of("rgb", scene.split.test)
    seen = field.render(frame.camera, frame.camera_to_world)
    expected = picture(frame.camera, frame.camera_to_world)
    assert np.square(seen.channels["rgb"] - expected).mean() < 0.25 * expected.var()
    assert np.isfinite(seen.depth_ray).mean() > 0.95  # every ray ends somewhere
    d = ray_map(frame.camera)[0] @ frame.camera_to_world[:3, :3].T
    b = d @ frame.camera_to_world[:3, 3]
    ball = b**2 - frame.camera_to_world[:3, 3] @ frame.camera_to_world[:3, 3] + 0.5**2 > 0
    assert ((seen.opacity > 0.5) == ball).mean() > 0.9  # and opacity is that of the region, not of the sky
    ball = expected[..., 0] == expected[..., 1]
    assert 2.4 < np.median(seen.depth_ray[ball]) < 3.2


class Killed(Exception):
    pass


@pytest.mark.parametrize("decide_at", [0.2, 0.8])  # before and after the kill
def test_a_killed_fit_resumes_to_the_same_field(scene: Scene, tmp_path: Path, decide_at: float) -> None:
    recipe = _recipe(
        **{"schedule.decide_at": decide_at, "radiance.view_dependence": "auto", "radiance.exposure": "on", "sampling.occupancy_every": 5}
    )
    whole = fit(scene, tmp_path / "whole", recipe=recipe, steps=24, seed=3)

    def kill(news: FitProgress) -> None:
        if news.step == 13:
            raise Killed

    with pytest.raises(Killed):
        fit(scene, tmp_path / "cut", recipe=recipe, steps=24, seed=3, checkpoint_every=0.0, on_step=kill)
    assert not (tmp_path / "cut" / "manifest.json").exists()
    news = []
    resumed = fit(scene, tmp_path / "cut", recipe=recipe, seed=3, resume=True, on_step=news.append)
    assert [n.step for n in news] == list(range(13, 25))  # the checkpoint of step 12 was the last before the kill
    expected = _tensors(whole)
    for name, value in _tensors(resumed).items():
        assert torch.equal(value, expected[name]), name
    assert resumed.view_dependence == whole.view_dependence
    same = ("exposure", "recipe", "seed", "steps", "train_psnr", "skipped_steps", "grid_reopened")
    assert {k: resumed.manifest[k] for k in same} == {k: whole.manifest[k] for k in same}
    assert resumed.manifest["needs"]["choices"] == whole.manifest["needs"]["choices"]


def test_a_fit_goes_on_anywhere_with_the_rays_that_were_drawn_ahead(scene: Scene) -> None:
    """Poses move, and it is chosen anew where rays go, between the drawing of rays and the step that learns from them."""
    changes = {"poses.views": "on", "poses.start_at": 0.3, "sampling.occupancy_every": 8}
    trainer, saved = _trainer(scene, 40, **changes), {}
    while trainer.progress < 1.0:
        trainer.run_step()
        saved[trainer.state.step] = copy.deepcopy(trainer.checkpoint())
    assert trainer.refinement.steps > 0 and trainer.refinement.motions.views.any()
    for step in (1, 11, 12, 13, 15, 16, 17, 31, 32, 39):
        other = _trainer(scene, 40, **changes)
        other.restore(saved[step])
        while other.progress < 1.0:
            other.run_step()
        expected = _tensors(trainer.field)
        assert all(torch.equal(value, expected[name]) for name, value in _tensors(other.field).items()), step


def test_what_is_arranged_beside_the_step_before_is_what_the_step_needs(scene: Scene) -> None:
    """Whatever was decided in between: where rays go, view dependence, rows of tables, lamps, exposure, poses."""
    changes = {
        "radiance.light": "auto", "schedule.light_until": 0.5, "schedule.view_dependence_from": 0.2, "radiance.view_dependence": 3,
        "schedule.tables_at": 0.15, "surface.max_rows_log2": 14, "radiance.max_rows_log2": 15, "surface.rays_per_row": 0.002,
        "radiance.rays_per_row": 0.001, "radiance.cells_per_pixel": 30.0, "surface.cells_per_row": 2.0, "radiance.cells_per_row": 2.0,
        "schedule.decide_at": 0.7, "radiance.exposure": "on", "poses.views": "on", "poses.start_at": 0.3, "sampling.evenly": 0.2,
    }  # fmt: skip
    beforehand, when_due = (_trainer(scene, 100, **changes) for _ in range(2))
    arranged = 0
    for _ in range(100):
        beforehand.run_step()
        arranged += beforehand.arranged is not None
        when_due.run_step()
        when_due.arranged = None
    assert arranged == 100 and beforehand.choices["tables"].changed and len(beforehand.choices) > len(beforehand.needs.choices) + 3
    theirs = when_due.field.state_dict()
    for name, value in beforehand.field.state_dict().items():
        assert torch.equal(value, theirs[name]), name
    assert beforehand.state == when_due.state


def test_a_fit_that_is_looked_at_comes_to_the_same_field(scene: Scene, tmp_path: Path) -> None:
    frame = scene.frames_of("rgb")[0]
    lit = []

    def render(field: Field) -> None:
        seen = field.render(resized(frame.camera, 24), field.pose_of(frame))
        lit.append(float(np.nanmean(seen.channels["rgb"])))
        assert np.isfinite(seen.depth_ray).any()

    looked_at = fit(scene, tmp_path / "looked_at", recipe=SMALL, steps=16, on_field=render)
    alone = _tensors(fit(scene, tmp_path / "alone", recipe=SMALL, steps=16))
    assert len(lit) == 16 and len(set(lit)) > 10  # of a field that changes
    for name, value in _tensors(looked_at).items():
        assert torch.equal(value, alone[name]), name


@pytest.mark.parametrize("average", [0.0, 0.2])
def test_the_field_is_the_mean_over_the_last_steps(scene: Scene, tmp_path: Path, average: float) -> None:
    field = fit(scene, tmp_path, recipe=_recipe(**{"schedule.ema_fraction": average}), steps=30)
    saved = read_checkpoint(tmp_path)
    assert saved is not None
    expected = {n.removeprefix("field."): m for n, m in saved["average"]["means"].items()} if average else saved["field"]
    for name, parameter in field.named_parameters():
        assert torch.equal(parameter, expected[name]), name
        # the fit itself goes on from where it was
        assert not average or not torch.equal(parameter, saved["field"][name]), name


def test_the_log_of_a_resumed_fit_has_every_step_once(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit is killed after a log line and before its checkpoint: that line is written again, not twice."""
    ticks = iter(float(i) * 2 for i in range(10_000))
    monkeypatch.setattr(run_module, "time", SimpleNamespace(perf_counter=lambda: next(ticks)))  # a log line every step

    def kill(news: FitProgress) -> None:
        if news.step == 5:
            raise Killed

    with pytest.raises(Killed):
        fit(scene, tmp_path, recipe=SMALL, steps=8, checkpoint_every=0.0, on_step=kill)
    log = tmp_path / "train.jsonl"
    log.write_text(log.read_text() + json.dumps({"step": 7, "elapsed": 0.0, "loss": 1.0, "psnr": {}}) + "\n")
    fit(scene, tmp_path, recipe=SMALL, steps=8, resume=True)
    lines = [json.loads(x) for x in log.read_text().splitlines()]
    assert [x["step"] for x in lines] == list(range(1, 9))
    assert all(math.isfinite(x["loss"]) and set(x["psnr"]) == set(scene.sensors) for x in lines)


def test_an_interrupted_fit_says_how_to_go_on(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = Trainer.run_step

    def interrupted(self: Trainer) -> None:
        if self.state.step == 2:
            raise KeyboardInterrupt
        step(self)

    monkeypatch.setattr(Trainer, "run_step", interrupted)
    with pytest.raises(Interrupted, match="--resume goes on from the last checkpoint") as stopped:
        fit(scene, tmp_path, recipe=SMALL, steps=5)
    assert stopped.value.exit_code == 130
    saved = read_checkpoint(tmp_path)
    assert saved is not None and saved["state"]["step"] == 0  # none of the steps since was saved, none of them half done


def test_what_a_gpu_compiles_in_a_step_is_not_time_of_training(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four steps of ten seconds the first and the third make kernels."""
    step, made, now = Trainer.run_step, [0, 1, 1, 2, 2], [0.0]

    def ten_seconds(self: Trainer) -> None:
        step(self)
        now[0] += 10.0

    monkeypatch.setattr(run_module, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(Trainer, "run_step", ten_seconds)
    monkeypatch.setattr(Trainer, "kernels_made", property(lambda self: made[self.state.step]))
    fit(scene, tmp_path, recipe=SMALL, steps=4)
    saved = read_checkpoint(tmp_path)
    assert saved is not None and saved["state"]["elapsed"] == 20.0


def test_the_seed_decides_the_field(scene: Scene, tmp_path: Path) -> None:
    a, b, c = (_tensors(fit(scene, tmp_path / str(i), recipe=SMALL, steps=6, seed=s)) for i, s in enumerate((0, 0, 1)))
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert not torch.equal(a["appearance.table"], c["appearance.table"])


def test_a_checkpoint_of_another_fit_is_refused(scene: Scene, tmp_path: Path) -> None:
    fit(scene, tmp_path, recipe=SMALL, steps=3)
    with pytest.raises(InputError, match="seed"):
        fit(scene, tmp_path, recipe=SMALL, steps=3, seed=1, resume=True)
    with pytest.raises(InputError, match="steps"):
        fit(scene, tmp_path, recipe=SMALL, steps=5, resume=True)
    with pytest.raises(InputError, match="recipe"):
        fit(scene, tmp_path, recipe=_recipe(**{"loss.eikonal_weight": 0.2}), steps=3, resume=True)
    with pytest.raises(InputError, match="scene"):
        fit(load_scene(data_folder("example_scene"), modalities=["rgb"]), tmp_path, recipe=SMALL, steps=3, resume=True)
    (tmp_path / "checkpoint" / "state.pt").write_bytes(b"broken")
    with pytest.raises(InputError, match="not a readable checkpoint"):
        fit(scene, tmp_path, recipe=SMALL, steps=3, resume=True)


# --- length


def test_a_fit_takes_the_steps_it_was_given(scene: Scene, tmp_path: Path) -> None:
    news: list[FitProgress] = []
    started = []
    fit(scene, tmp_path, recipe=SMALL, steps=7, on_start=started.append, on_step=news.append)
    assert [n.step for n in news] == list(range(1, 8))
    np.testing.assert_allclose([n.done for n in news], np.arange(1, 8) / 7)
    assert len(started) == 1 and started[0].design.surface_levels == 4
    assert all(n.rays_per_s > 0 and n.samples_per_s > n.rays_per_s / 10 and set(n.psnr) == set(scene.sensors) for n in news)


def test_a_budget_ends_a_fit_by_the_clock(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that goes on by a second each time it is asked."""
    ticks = iter(range(10_000))
    monkeypatch.setattr(run_module, "time", SimpleNamespace(perf_counter=lambda: float(next(ticks))))
    news: list[FitProgress] = []

    def kill(n: FitProgress) -> None:
        news.append(n)
        if n.step == 4:
            raise Killed

    with pytest.raises(Killed):
        fit(scene, tmp_path, recipe=SMALL, budget=12.0, checkpoint_every=0.0, on_step=kill)
    assert all(n.done == pytest.approx(n.elapsed / 12.0) for n in news)
    before = news[2].elapsed
    news.clear()
    field = fit(scene, tmp_path, recipe=SMALL, resume=True, on_step=news.append)  # the budget is the checkpoint's
    assert news[0].step == 4 and before < news[0].elapsed < news[-1].elapsed
    assert news[-1].done == 1.0 and all(n.done < 1.0 for n in news[:-1]) and 12.0 <= news[-1].elapsed < 16.0
    assert field.manifest["seconds"]["fit"] == news[-1].elapsed


def test_length_is_steps_or_time(scene: Scene) -> None:
    for steps, budget in ((5, 5.0), (None, None)):
        with pytest.raises(InputError, match="either a number of steps or a time budget"):
            Trainer(scene, SMALL, steps, budget, 0, "cpu")


@pytest.mark.parametrize("grown", [1.0, 9.0])
def test_the_number_of_rays_follows_the_samples(scene: Scene, grown: float) -> None:
    trainer = _trainer(scene, 80, **{"sampling.occupancy_every": 4, "sampling.samples_growth": grown})
    counts, samples, wanted = [trainer.state.rays], [], []
    for _ in range(80):
        before = trainer.state.samples_total
        wanted.append(samples_of_step(trainer.progress, trainer.recipe))
        trainer.run_step()
        counts.append(trainer.state.rays)
        samples.append(trainer.state.samples_total - before)
    growth = np.array(counts[1:]) / np.array(counts[:-1])
    assert growth.max() <= 1.5 and growth.min() >= 0.74
    taken = np.array(samples) / np.array(wanted)
    assert counts[0] == 128 and 0.7 < np.median(taken[-15:]) < 1.4
    assert np.median(samples[-10:]) / np.median(samples[35:45]) == pytest.approx(grown ** (35 / 80), rel=0.2)


# --- what is not a number


def test_a_loss_that_is_not_finite_skips_the_step(scene: Scene) -> None:
    trainer = _trainer(scene)
    trainer.run_step()
    with torch.no_grad():
        trainer.field.shader.heads.bias[0] = torch.nan
    before, count = _tensors(trainer.field), trainer.optimiser.count
    trainer.run_step()
    assert (trainer.state.step, trainer.state.bad_steps, trainer.optimiser.count) == (2, 1, count)
    after = _tensors(trainer.field)
    assert all(torch.equal(before[n].nan_to_num(), after[n].nan_to_num()) for n in before)
    with torch.no_grad():
        trainer.field.shader.heads.bias[0] = 0.0
    trainer.run_step()
    assert (trainer.state.step, trainer.state.bad_steps, trainer.optimiser.count) == (3, 1, count + 1)
    assert all(torch.isfinite(p).all() for p in trainer.field.parameters()) and math.isfinite(trainer.state.mean_loss)


@pytest.mark.parametrize("what", ["surface.output_weight", "shader.heads.weight", "surface.grid.table"])
def test_a_gradient_that_is_not_finite_skips_the_step(scene: Scene, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer, learn = _trainer(scene), kernels.learn
    trainer.run_step()
    parameters = dict(trainer.field.named_parameters())
    # what is NaN in a table's gradient came by the network
    wrong = [parameters[n] for n in ([what, "surface.hidden"] if what == "surface.grid.table" else [what])]

    def broken(*args: Any) -> kernels.Learned:
        for parameter in wrong:
            parameter.grad[0] = torch.nan  # what is added to it is so, too
        return learn(*args)

    before, moments = _tensors(trainer.field), {n: [x.clone() for x in m] for n, m in trainer.optimiser.moments.items()}
    with monkeypatch.context() as patch:
        patch.setattr(kernels, "learn", broken)
        trainer.run_step()
    assert (trainer.state.bad_steps, trainer.optimiser.count) == (1, 1)
    assert all(torch.equal(value, before[name]) for name, value in _tensors(trainer.field).items())
    assert all(torch.equal(x, y) for n, m in trainer.optimiser.moments.items() for x, y in zip(m, moments[n], strict=True))
    assert not any(p.grad.any() for p in trainer.field.parameters() if p.grad is not None)  # nothing is left for the next step
    trainer.run_step()
    assert (trainer.state.bad_steps, trainer.optimiser.count) == (1, 2)
    assert all(torch.isfinite(p).all() for p in trainer.field.parameters())


def test_skipped_steps_are_counted_and_reported(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    warm_up()  # else it is the first to call what is counted here
    calls = []
    learn = kernels.learn

    def sometimes(*args: Any) -> kernels.Learned:
        calls.append(1)
        learned = learn(*args)
        return learned._replace(loss=learned.loss * (torch.nan if len(calls) in (1, 4) else 1.0))

    monkeypatch.setattr(kernels, "learn", sometimes)
    news: list[FitProgress] = []
    field = fit(scene, tmp_path, recipe=SMALL, steps=6, on_step=news.append)
    assert field.manifest["skipped_steps"] == 2 and field.manifest["steps"] == 6
    assert all(math.isfinite(n.loss) for n in news[1:]), "a first step that was skipped leaves nothing in the running mean"


def test_a_fit_of_nothing_but_bad_steps_gives_up(scene: Scene, tmp_path: Path) -> None:
    trainer = _trainer(scene, 100)
    with torch.no_grad():
        trainer.field.surface.output_weight[-1] = torch.nan
    with pytest.raises(DivergedError, match="not finite in 20 steps"):
        for _ in range(100):
            trainer.run_step()
    assert trainer.state.step == 20


# --- what a loss is made of


def _loss(trainer: Trainer, batch: Any, **changes: Any) -> float:
    trainer.recipe = _recipe(**changes)
    sampling = sampling_at(0.2, trainer.recipe, trainer.needs)
    generator = torch.Generator().manual_seed(0)
    points, noise = torch.rand(256, 3, generator=generator) * 2 - 1, torch.randn(768, 3, generator=generator)
    drawn = DrawnStep(batch, _rays(trainer, batch), points, noise, torch.empty(0, 3), generator)
    return float(kernels.learn(kernels.arrange(trainer._of_step(drawn, sampling, trainer.progress))).loss)


def _rays(trainer: Trainer, batch: Any) -> kernels.Rays:
    return kernels.Rays(batch.origins, batch.directions, *interval(trainer.field.surface, batch.origins, batch.directions), batch.jitter)


@torch.no_grad()
def _opacity(trainer: Trainer, batch: Any) -> torch.Tensor:
    from mmsynth.field import rendering

    sampling = sampling_at(0.2, trainer.recipe, trainer.needs)
    field = trainer.field
    return rendering.trace(
        field.surface, field.appearance, field.occupancy, batch.origins, batch.directions, batch.jitter, sampling
    ).opacity


def _batch(trainer: Trainer, rays: int) -> Any:
    counts = dict.fromkeys(trainer.measurements, rays)
    return draw(trainer.measurements, trainer.field.shader.columns, counts, np.random.default_rng(0))


def test_black_pixels_of_a_black_scene_ask_for_emptiness(tmp_path: Path) -> None:
    trainer = _trainer(_ball_scene(tmp_path, disc))
    assert trainer.needs.black_background and not trainer.needs.design.background
    batch = _batch(trainer, 400)
    with torch.no_grad():  # all opaque, so that there is something to lose
        trainer.field.surface.output_weight[-1] = -0.6
    opacity = _opacity(trainer, batch)
    black = batch.measured.target.reshape(400, 3).amax(1) == 0
    assert 50 < black.sum() < 350 and (opacity[black] > 0.5).sum() > 50
    more = _loss(trainer, batch, **{"loss.background_opacity_weight": 0.5, "loss.eikonal_weight": 0.0}) - _loss(
        trainer, batch, **{"loss.background_opacity_weight": 0.0, "loss.eikonal_weight": 0.0}
    )
    assert more == pytest.approx(0.5 * float((opacity * black).mean()), rel=1e-4)


def test_alpha_asks_for_opacity(tmp_path: Path) -> None:
    trainer = _trainer(_ball_scene(tmp_path, transparent_disc))
    assert trainer.has_opacity and not trainer.needs.design.background
    batch = _batch(trainer, 400)
    assert set(batch.alpha.tolist()) == {0.0, 1.0}
    opacity = _opacity(trainer, batch)
    more = _loss(trainer, batch, **{"loss.alpha_weight": 0.7, "loss.eikonal_weight": 0.0}) - _loss(
        trainer, batch, **{"loss.alpha_weight": 0.0, "loss.eikonal_weight": 0.0}
    )
    assert more == pytest.approx(0.7 * float((opacity - batch.alpha).square().mean()), rel=1e-4)
    assert _loss(trainer, batch, **{"loss.alpha_weight": 0.0, "loss.background_opacity_weight": 9.0, "loss.eikonal_weight": 0.0}) == _loss(
        trainer, batch, **{"loss.alpha_weight": 0.0, "loss.eikonal_weight": 0.0}
    )


def test_what_is_solid_where_alpha_says_nothing_is_asked_to_open(tmp_path: Path) -> None:
    """Once all levels are active, and not where the object is."""
    trainer = _trainer(_ball_scene(tmp_path, transparent_disc))
    batch = _batch(trainer, 400)
    with torch.no_grad():  # all opaque
        trainer.field.surface.output_weight[-1] = -0.6
    opacity = _opacity(trainer, batch)
    solid = (batch.alpha == 0) & (opacity > 0.5)
    assert 50 < solid.sum() < 350
    ask = lambda weight: _loss(trainer, batch, **{"loss.blocked_weight": weight, "loss.alpha_weight": 0.0, "loss.eikonal_weight": 0.0})
    assert ask(0.7) == ask(0.0)
    trainer.steps, trainer.state.step = 100, 40  # as far as levels_until of these tests
    assert trainer.progress == SMALL.schedule.levels_until
    depth = -torch.log(1.0 - opacity[solid] + np.exp(-SMALL.sampling.max_optical_depth))
    assert ask(0.7) - ask(0.0) == pytest.approx(0.7 * float(depth.sum()) / 400, rel=1e-3)


def test_an_object_on_black_is_found(tmp_path: Path) -> None:
    """A sphere of radius 0.6 or so, seen by every ray through the discs and by no other."""
    for picture in (disc, transparent_disc):
        folder = tmp_path / picture.__name__
        folder.mkdir()
        scene = _ball_scene(folder, picture)
        field = fit(scene, folder / "run", recipe=SMALL, steps=200)
        frame = scene.frames_of("rgb", (5,))[0]
        seen = field.render(frame.camera, frame.camera_to_world)
        v, u = np.mgrid[:18, :24]
        r = np.hypot(u - 11.5, v - 8.5)
        assert (seen.opacity[r < 4] > 0.9).all() and (seen.opacity[r > 7] < 0.1).all()
        np.testing.assert_allclose(np.median(seen.channels["rgb"][r < 4], 0), 0.8, atol=0.1)


def test_alpha_premultiplies_colours_and_becomes_opacity(write_transforms: Callable[..., Path]) -> None:
    root = write_transforms(channels=3)
    for i, path in enumerate(sorted((root / "images").glob("*.png"))):
        assert cv2.imwrite(str(path), np.random.default_rng(i).integers(0, 256, (18, 24, 4), np.uint8))
    scene = load_scene(root)
    measurements = load_measurements(scene)
    batch = draw(measurements, {"rgb": slice(0, 3)}, {"rgb": 20_000}, np.random.default_rng(0))
    assert torch.isfinite(batch.alpha).all() and len(batch.alpha.unique()) > 50
    first = batch.frame[::3] == 0
    seen = torch.cat([batch.measured.target.reshape(-1, 3), batch.alpha[:, None]], 1)[first].numpy()
    pixels, alpha = load_frame(measurements["rgb"].sensor, scene.frames_of("rgb", scene.split.train)[0])
    assert alpha is not None
    stored = np.concatenate([pixels * alpha[..., None], alpha[..., None]], 2).reshape(-1, 4)
    assert {*map(tuple, seen)} == {*map(tuple, stored)}


@pytest.mark.parametrize("background", ["off", "on"])
def test_eikonal_points_lie_at_the_surface_and_everywhere(scene: Scene, background: str) -> None:
    trainer = _trainer(scene, **{"surface.background": background})
    sampling = sampling_at(0.0, trainer.recipe, trainer.needs)
    to_draw = trainer._to_draw(0, 64)
    drawn = drawn_step(trainer.field, trainer.measurements, to_draw, [kernels.draw(*drawing) for drawing in to_draw.drawings])
    asked = eikonal(trainer.field, sampling, trainer.recipe, 0.0, drawn.points, drawn.noise)
    grid = trainer.field.surface.grid
    assert grid.extent == (2.0 if background == "on" else 1.0)
    assert asked.points.shape == (32, 3) and asked.noise.shape == (96, 3)
    assert (asked.points.abs() <= grid.extent).all() and asked.points.abs().max() > 0.8 * grid.extent
    assert float(asked.noise.std()) == pytest.approx(3.0 / sampling.sharpness, rel=0.1)  # within the soft surface
    assert asked.weight == SMALL.loss.eikonal_weight and asked.epsilon == grid.cell(sampling.active_surface)


# --- what is built


def test_only_needed_parts_are_built(scene: Scene) -> None:
    trainer = _trainer(scene)
    assert not trainer.field.design.background and trainer.choices["background"].why.startswith("off")
    forced = _trainer(scene, **{"surface.background": "on"})
    assert forced.field.design.background and "asked for by the recipe" in forced.choices["background"].why
    assert forced.field.surface.grid.extent == forced.field.appearance.extent == forced.field.occupancy.extent == 2.0
    rgb = load_scene(data_folder("example_scene"), modalities=["rgb"])
    assert _trainer(rgb).choices["tensor_head"].why.startswith("off")


def test_detail_follows_the_pixels_and_what_the_fit_can_see_of_them(scene: Scene) -> None:
    long, short = (_trainer(scene, steps).needs for steps in (100_000, 20))
    cameras = [f.camera for f in scene.frames]
    distance = np.median([np.linalg.norm(f.camera_to_world[:3, 3] - scene.region.centre) for f in scene.frames]) / scene.region.radius
    assert long.footprint == pytest.approx(distance / np.median([c.fx for c in cameras]), rel=0.02)
    assert short.footprint > 2 * long.footprint
    assert short.design.surface_finest <= long.design.surface_finest and short.sharpness_end < long.sharpness_end


def test_a_long_fit_is_sharp_sooner(scene: Scene) -> None:
    """In steps it is later: what two minutes take is more than half of what one does."""
    measurements = load_measurements(scene)
    until = [assess(scene, measurements, Recipe(), 0, rays).sharpness_until for rays in (1.0, 4.2e6, 8.4e6, 2.2e7, 1e12)]
    assert until == pytest.approx([0.6, 0.6, 0.6 * 2**-0.25, 0.4, 0.4], rel=1e-6)
    half = assess(scene, measurements, Recipe().with_changes({"schedule.sharpness_until": 0.3}), 0, 1e12)
    assert half.sharpness_until == pytest.approx(0.2) and sampling_at(0.2, Recipe(), half).sharpness == pytest.approx(half.sharpness_end)
    assert sampling_at(0.19, Recipe(), half).sharpness < 0.9 * half.sharpness_end


def test_a_grid_in_which_nothing_is_left_opens_again_and_it_is_counted(scene: Scene) -> None:
    trainer = _trainer(scene, **{"sampling.occupancy_every": 1})
    trainer.run_step()
    assert trainer.state.reopened == 0
    with torch.no_grad():
        trainer.field.surface.output_weight[-1] = 5.0
    trainer.run_step()
    assert trainer.state.reopened == 1 and (trainer.field.occupancy.states == SHELL).all()


def test_rig_is_that_of_every_view(scene: Scene) -> None:
    rig = rig_of(scene)
    assert list(rig) == list(scene.sensors) and np.array_equal(rig["rgb"], np.eye(4))
    reference = {f.view: f.camera_to_world for f in scene.frames_of("rgb")}
    for name, to_reference in rig.items():
        for frame in scene.frames_of(name):
            np.testing.assert_allclose(reference[frame.view] @ to_reference, frame.camera_to_world, atol=1e-6)
    apart = Scene(
        scene.root, scene.format, scene.sensors,
        tuple(f for f in scene.frames if (f.sensor == "ms") == (f.view > 5)), scene.region, scene.split,
    )  # fmt: skip
    assert "ms" not in rig_of(apart) and "pol" in rig_of(apart)


def test_devices() -> None:
    assert pick_device("cpu") == "cpu" and pick_device("auto") in ("cpu", "cuda")
    with pytest.raises(InputError, match="expected auto, cpu or cuda"):
        pick_device("tpu")
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="no CUDA device"):
            pick_device("cuda")


# --- recipe and schedule


def test_a_fit_goes_from_coarse_to_fine(scene: Scene) -> None:
    needs = _trainer(scene).needs
    at = [sampling_at(p, SMALL, needs) for p in np.linspace(0, 1, 101)]
    sharpness = np.array([s.sharpness for s in at])
    assert sharpness[0] == 20.0 and (np.diff(sharpness) >= 0).all()
    np.testing.assert_allclose(sharpness[60:], needs.sharpness_end)
    np.testing.assert_allclose(np.diff(np.log(sharpness[:61])), np.log(needs.sharpness_end / 20.0) / 60, rtol=1e-6)
    np.testing.assert_allclose([s.step for s in at], np.minimum(0.1, 2.0 / sharpness))
    assert at[0].active_surface == at[0].active_radiance == 2 and {s.active_surface for s in at} == {2, 3, 4}
    assert all(s.active_surface == s.active_radiance == 4 for s in at[40:])
    factors = at[50].sphere_step_factor, at[50].min_slope, at[50].min_section_weight, at[50].max_optical_depth
    assert factors == (0.7, 0.5, 0.01, 3.0)


def test_the_learning_rate_rises_and_falls() -> None:
    factors = np.array([learning_rate_factor(p, SMALL) for p in np.linspace(0, 1, 101)])
    assert factors[0] == 0.02 and (factors[1:34] == 1).all() and (np.diff(factors[34:]) < 0).all()
    assert factors[-1] == pytest.approx(0.1)


def test_only_the_network_of_a_surface_that_is_sharp_remembers_gradients_for_long(scene: Scene) -> None:
    trainer = _trainer(scene)
    sampling = sampling_at(0.5, SMALL, trainer.needs)

    def beta2(progress: float) -> dict[str, float]:
        trainer.state.step = round(1000 * progress)
        return {name: part.step.beta2 for name, part in zip(trainer.optimiser.parameters, trainer._update(sampling), strict=True)}

    trainer.steps = 1000
    assert set(beta2(trainer.needs.sharpness_until - 0.01).values()) == {0.99}
    assert {name for name, own in beta2(trainer.needs.sharpness_until).items() if own == 0.999} == {
        "surface.hidden",
        "surface.output_weight",
    }


def test_late_steps_take_more_samples() -> None:
    samples = np.array([samples_of_step(p, SMALL) for p in np.linspace(0, 1, 101)])
    np.testing.assert_allclose(samples[[0, 50, 100]], [1024, 2048, 4096])
    np.testing.assert_allclose(samples[1:] / samples[:-1], 4**0.01)


def test_recipes() -> None:
    for path in data_folder("recipes").glob("*.toml"):
        load_recipe(path.stem)
    with pytest.raises(InputError, match="expected one of"):
        load_recipe("nonsense")


def test_bad_recipe_files(tmp_path: Path) -> None:
    path = tmp_path / "r.toml"
    cases = [
        ("speed = 3", "speed"),
        ("loss.eikonal_weight = -1", "eikonal_weight"),
        ("loss.eikonal_weight = ", "not valid TOML"),
        ("surface.hidden_width = 6", "multiple of 4"),
        ("[loss]\nspeed = 3", "loss.speed"),
        ("surface_levels = 4", r"surface_levels: is no section of a recipe, expected keys in the sections \[surface\]"),
        ("poses = 'on'", "sections"),
    ]
    for text, message in cases:
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            load_recipe(str(path))
