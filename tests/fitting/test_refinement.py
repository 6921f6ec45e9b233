"""Poses that are off, refined while the packaged example is learned."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from mmsynth.field.field import Field
from mmsynth.field.storage import load_field
from mmsynth.fitting import motions as poses
from mmsynth.fitting.checkpoint import read_checkpoint
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.refinement import Refinement
from mmsynth.fitting.run import fit
from mmsynth.fitting.schedule import sampling_at
from mmsynth.fitting.trainer import Trainer
from mmsynth.operations.views.load import views_of_frames
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Frame, Scene, keep_frames

SMALL = {
    "sampling.samples_per_step": 4096, "sampling.samples_growth": 1.0,
    "sampling.initial_rays": 256, "surface.levels": 4, "surface.max_rows_log2": 13,
    "radiance.levels": 5, "radiance.max_rows_log2": 14, "sampling.occupancy_resolution": 32, "loss.eikonal_points": 256,
    "radiance.hidden_width": 32, "radiance.view_dependence": 1,
}  # fmt: skip
STEPS = 400


def _recipe(**changes: object) -> Recipe:
    return Recipe().with_changes({**SMALL, **changes})


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(data_folder("example_scene"), modalities=["rgb", "mono", "pol"])


def _disturbed(scene: Scene, views: float, sensors: float) -> Scene:
    """The scene with its training views, and its sensors but the first, off by about so many pixels, root mean square."""
    random = np.random.default_rng(4)
    first = next(iter(scene.sensors))
    anchors = {f.view: f.camera_to_world for f in scene.frames_of(first)}
    away = np.linalg.norm(next(iter(anchors.values()))[:3, 3] - np.array(scene.region.centre))
    unit = np.repeat([1.0, away], 3) / scene.frames_of(first)[0].camera.fx / np.sqrt(2)
    of_views = {v: poses.motion_to_matrix(views * unit * random.normal(size=(1, 6)))[0] for v in scene.split.train}
    of_sensors = {n: poses.motion_to_matrix(sensors * unit * random.normal(size=(1, 6)) * (n != first))[0] for n in scene.sensors}

    def moved(frame: Frame) -> Frame:
        anchor = anchors[frame.view]
        pose = anchor @ of_views.get(frame.view, np.eye(4)) @ np.linalg.inv(anchor) @ frame.camera_to_world @ of_sensors[frame.sensor]
        return dataclasses.replace(frame, camera_to_world=pose)

    return dataclasses.replace(scene, frames=tuple(moved(f) for f in scene.frames))


def _pixels_off(scene: Scene, field: Field | None, true: Scene) -> float:
    """Root mean square displacement of the region in the training pictures; poses as the input has them, or as the field does."""
    points = np.array(scene.region.centre) + 0.5 * scene.region.radius * np.array([*np.eye(3), *-np.eye(3)])
    squares = []
    for ours, theirs in zip(scene.frames, true.frames, strict=True):
        if ours.view in scene.split.train:
            pictures = []
            for pose in (ours.camera_to_world if field is None else field.pose_of(ours), theirs.camera_to_world):
                seen = (points - pose[:3, 3]) @ pose[:3, :3]
                pictures.append(ours.camera.fx * seen[:, :2] / seen[:, 2:])
            squares.append(np.square(pictures[0] - pictures[1]).sum(1).mean())
    return float(np.sqrt(np.mean(squares)))


def _run(trainer: Trainer, until: float = 1.0) -> Trainer:
    while trainer.progress < until:
        trainer.run_step()
    return trainer


def test_exact_poses_are_left_alone(scene: Scene) -> None:
    trainer = Trainer(scene, _recipe(), STEPS, None, 0, "cpu")
    before = {n: (m.rotations.copy(), m.origins.copy()) for n, m in trainer.measurements.items()}
    _run(trainer, 0.6)
    assert not trainer.refinement.decided.views.value and not trainer.refinement.decided.rig.value, trainer.choices
    assert trainer.choices["poses"].why.startswith("off: motions of views would save")
    for name, m in trainer.measurements.items():
        assert np.array_equal(m.rotations, before[name][0]) and np.array_equal(m.origins, before[name][1])
    assert trainer.refinement.corrections().views == {} and trainer.refinement.sizes() == {"views": {}, "sensors": {}}


@pytest.mark.parametrize(("views", "sensors"), [(1.5, 0.0), (0.0, 1.5)])
def test_poses_that_are_off_are_found_and_mended(scene: Scene, tmp_path: Path, views: float, sensors: float) -> None:
    off = _disturbed(scene, views, sensors)
    field = fit(off, tmp_path, recipe=_recipe(), steps=STEPS)
    choices = field.manifest["needs"]["choices"]
    for name, wanted in (("poses", views), ("rig", sensors)):
        assert choices[name]["why"].startswith("on" if wanted else "off") and choices[name]["value"] is bool(wanted), choices
    assert _pixels_off(off, field, scene) < 0.5 * _pixels_off(off, None, scene)
    stored = field.manifest["poses"]
    assert set(stored["views"]) == ({str(v) for v in scene.split.train} if views else set())
    assert set(stored["sensors"]) == (set(list(scene.sensors)[1:]) if sensors else set())
    # what was found is what operations see, also after the run was read again
    again = load_field(tmp_path)
    for frame in off.frames:
        assert np.array_equal(again.pose_of(frame), field.pose_of(frame))
    for at in views_of_frames(again, off, "mono"):
        frame = next(f for f in off.frames if f.sensor == "mono" and f"{f.view:04d}" == at.name)
        assert at.camera == frame.camera and np.array_equal(at.camera_to_world, field.pose_of(frame))
    if views:
        view = off.split.train[0]
        frame = next(f for f in off.frames if f.sensor == "mono" and f.view == view)
        assert stored["views"][str(view)]["camera_to_world"]["mono"] == field.pose_of(frame).tolist()
        assert stored["views"][str(view)]["pixels"] > 0.1
        # held-out views have no motion of their own
        held_out = next(f for f in off.frames if f.view == off.split.test[0])
        assert np.array_equal(field.pose_of(held_out), held_out.camera_to_world)
    else:
        on_rig = np.linalg.inv(field.pose_of(off.frames_of("rgb")[0])) @ field.pose_of(off.frames_of("mono")[0])
        assert field.rig["mono"] == pytest.approx(on_rig, abs=1e-9)


def test_corrections_say_in_the_scenes_frame_where_the_cameras_stand_now(scene: Scene) -> None:
    trainer = Trainer(_disturbed(scene, 1.0, 1.0), _recipe(**{"poses.views": "on", "poses.rig": "on"}), STEPS, None, 0, "cpu")
    random = np.random.default_rng(0)
    refinement = trainer.refinement
    refinement.motions = poses.Motions(
        *(0.01 * random.normal(size=m.shape) for m in (refinement.motions.views, refinement.motions.sensors))
    )
    trainer.field.corrections = refinement.corrections()
    now = poses.moved(refinement.layout, refinement.motions)
    frames = [f for n in trainer.measurements for f in scene.frames_of(n, scene.split.train)]
    disturbed = {(f.sensor, f.view): f for f in _disturbed(scene, 1.0, 1.0).frames}
    for frame, pose in zip(frames, now, strict=True):
        found = trainer.field.pose_of(disturbed[frame.sensor, frame.view])
        assert found[:3, :3] == pytest.approx(pose[:3, :3], abs=1e-12)
        assert found[:3, 3] == pytest.approx(pose[:3, 3] * scene.region.radius + np.array(scene.region.centre), abs=1e-12)


def test_a_look_at_rays_leaves_the_next_step_alone(scene: Scene) -> None:
    trainer = _run(Trainer(scene, _recipe(**{"poses.views": "off", "poses.rig": "off"}), STEPS, None, 0, "cpu"), 0.05)
    sampling = sampling_at(trainer.progress, trainer.recipe, trainer.needs)
    (rows,) = trainer._looks(sampling, dict.fromkeys(trainer.measurements, 50), 1, np.random.default_rng(0))
    assert len(rows.residual) == 150 and bool(torch.isfinite(rows.by_origin).all()) and bool((rows.by_direction != 0).any())
    assert all(p.grad is None or not p.grad.any() for p in trainer.field.parameters())
    assert all(p.requires_grad for p in trainer.field.parameters())


def test_looks_side_by_side_are_those_of_one_thread(scene: Scene, use_threads: Callable[[int], None]) -> None:
    """All that they see, and in their order; drawn, each, after the one before."""
    trainer = _run(Trainer(scene, _recipe(**{"poses.views": "off", "poses.rig": "off"}), STEPS, None, 0, "cpu"), 0.05)
    sampling, counts = sampling_at(trainer.progress, trainer.recipe, trainer.needs), dict.fromkeys(trainer.measurements, 50)
    found = []
    for threads in (1, 2, 3):
        use_threads(threads)
        found.append(list(trainer._looks(sampling, counts, 5, np.random.default_rng(0))))
    for alone, *others in zip(*found, strict=True):
        for field in dataclasses.fields(alone):
            assert all(torch.equal(getattr(alone, field.name), getattr(other, field.name)) for other in others)
    assert len(found[0]) == 5 and not torch.equal(found[0][0].residual, found[0][1].residual)


def test_looks_of_a_long_fit_take_a_tenth_of_its_rays(scene: Scene) -> None:
    trainer = Trainer(scene, _recipe(), STEPS, None, 0, "cpu")
    asked: list[int] = []
    nothing = lambda rays, count, random: asked.append(count * sum(rays.values())) or []
    waits = []
    for rays in (1e5, 1e7):
        refinement = Refinement(scene, trainer.measurements, trainer.recipe.poses, trainer.needs.footprint, rays, 0)
        refinement.decided = refinement._decisions(True, False, "", "")
        refinement.step(nothing, 0.5)
        waits.append(refinement.next - 0.5)
    assert asked[0] == asked[1] and asked[1] / waits[1] == pytest.approx(1e6, rel=0.1)
    assert asked[0] / waits[0] == pytest.approx(4e5, rel=0.1)


def test_looks_in_vain_come_ever_later_until_one_says_something(scene: Scene) -> None:
    refinement = Trainer(scene, _recipe(**{"poses.views": "on", "poses.rig": "off"}), STEPS, None, 0, "cpu").refinement
    layout, off = refinement.layout, np.array([0.0, 0.0, 0.0, 0.02, 0.0, 0.0])
    frame = torch.from_numpy(np.random.default_rng(0).permutation(np.repeat(np.arange(len(layout.poses)), 90)))
    rotations = torch.from_numpy(layout.poses[:, :3, :3])[frame]
    signal = 0.0

    def look(random: np.random.Generator) -> poses.RayJacobian:
        across, ahead = (torch.from_numpy(random.normal(size=(len(frame), 3))) for _ in range(2))
        rows = poses.RayJacobian(frame, torch.zeros(len(frame)), across, 2.0 * across, ahead / ahead.norm(dim=1, keepdim=True))
        noise = 0.1 * torch.from_numpy(random.normal(size=len(frame)))
        return dataclasses.replace(rows, residual=noise + signal * poses.derivative(rows, rotations) @ torch.from_numpy(off))

    look_so_often = lambda _, count, random: [look(random) for _ in range(count)]
    looks = [refinement.recipe.start_at]
    for _ in range(8):
        assert refinement.due(looks[-1]) and not refinement.due(looks[-1] - 1e-6)
        refinement.step(look_so_often, looks[-1])
        looks.append(refinement.next)
    waits = np.diff(looks)
    assert not refinement.motions.views.any() and (np.diff(waits) > 0).all()
    signal = 1.0
    before = refinement.next
    while not refinement.motions.views.any():
        refinement.step(look_so_often, before := refinement.next)
    assert refinement.next - before < 0.5 * waits[1]


@pytest.mark.parametrize("views", [2.0, 0.0])
def test_a_broken_off_refinement_goes_on_to_the_same_field(scene: Scene, tmp_path: Path, views: float) -> None:
    off = _disturbed(keep_frames(scene, {"mono": 4, "pol": 4}), views, 0.0)
    recipe = _recipe(**{"poses.views": "on", "poses.rig": "on", "poses.start_at": 0.1})
    whole = _run(Trainer(off, recipe, 60, None, 0, "cpu"))
    part = _run(Trainer(off, recipe, 60, None, 0, "cpu"), 0.4)
    assert part.refinement.steps > 1
    waits = lambda: part.refinement.motions.views.any() if views else part.refinement.unsure is not None
    while part.progress < 0.9 and not waits():
        part.run_step()  # where nothing is off, what looks said waits for more of it, but not after each of them
    assert part.progress < 0.9 and waits()
    torch.save(part.checkpoint(), tmp_path / "state.pt")
    after = Trainer(off, recipe, 60, None, 0, "cpu")
    after.restore(torch.load(tmp_path / "state.pt", weights_only=True))
    _run(after)
    assert np.array_equal(after.refinement.motions.views, whole.refinement.motions.views)
    assert np.array_equal(after.refinement.motions.sensors, whole.refinement.motions.sensors)
    for name, tensor in whole.field.state_dict().items():
        assert torch.equal(tensor, after.field.state_dict()[name]), name
    assert after.choices == whole.choices


def test_the_recipe_forces_and_what_cannot_move_does_not(scene: Scene) -> None:
    forced = _run(Trainer(scene, _recipe(**{"poses.views": "on", "poses.rig": "off", "poses.start_at": 0.0}), 20, None, 0, "cpu"))
    assert forced.refinement.decided is not None
    assert forced.refinement.decided.views.value and not forced.refinement.decided.rig.value
    assert "asked for by the recipe" in forced.choices["poses"].why and "asked for by the recipe" in forced.choices["rig"].why
    alone = dataclasses.replace(scene, split=dataclasses.replace(scene.split, train=scene.split.train[:1]))
    one = _run(Trainer(alone, _recipe(**{"poses.views": "on", "poses.start_at": 0.0}), 10, None, 0, "cpu"))
    assert one.refinement.decided is not None and not one.refinement.decided.views.value
    assert one.choices["poses"].why == "off: there is one view"
    single = Trainer(
        load_scene(data_folder("example_scene"), modalities=["rgb"]),
        _recipe(**{"poses.rig": "on", "poses.views": "off"}),
        10,
        None,
        0,
        "cpu",
    )
    assert single.choices["rig"].why == "off: no two sensors share views"


def test_the_choice_is_in_the_manifest_and_the_checkpoint(scene: Scene, tmp_path: Path) -> None:
    fit(scene, tmp_path, recipe=_recipe(), steps=60)
    choices = json.loads((tmp_path / "manifest.json").read_text())["needs"]["choices"]
    saved = read_checkpoint(tmp_path)
    assert saved is not None
    assert saved["refinement"]["decided"] == {"views": choices["poses"], "rig": choices["rig"]}
