"""Cameras that a fit did not learn from: put where the field shows what they saw, or left where they are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from analytic import MONO, RGB
from painted_ball import CAMERA, painted_ball, scene_of_ball

from mmsynth.field.design import Corrections
from mmsynth.field.field import Field
from mmsynth.operations.evaluation import placing
from mmsynth.operations.evaluation.evaluate import evaluate
from mmsynth.operations.evaluation.placing import place
from mmsynth.report.text import score_text
from mmsynth.scene.motion import motion_to_matrix
from mmsynth.scene.scene import Frame, Scene
from mmsynth.sensors.camera import project

POINTS = 0.7 * np.array([*np.eye(3), *-np.eye(3)])


@pytest.fixture(autouse=True)
def _few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(placing, "_PER_FRAME", 1024)


@pytest.fixture(scope="module")
def field() -> Field:
    return painted_ball(RGB, MONO)


@pytest.fixture(scope="module")
def scene(field: Field, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return scene_of_ball(field, tmp_path_factory.mktemp("frames"), 2, 3)


def _moved(scene: Scene, views: tuple[int, ...]) -> Scene:
    """With these views off by a pixel or two, the rig as one."""
    random = np.random.default_rng(3)
    anchors = {f.view: f.camera_to_world for f in scene.frames_of("rgb")}
    unit = np.repeat([1.0, np.linalg.norm(anchors[0][:3, 3])], 3) / CAMERA.fx
    of_views = {
        v: a @ motion_to_matrix(0.5 * unit * random.normal(size=(1, 6)))[0] @ np.linalg.inv(a) for v, a in anchors.items() if v in views
    }
    frames = (dataclasses.replace(f, camera_to_world=of_views[f.view] @ f.camera_to_world) if f.view in views else f for f in scene.frames)
    return dataclasses.replace(scene, frames=tuple(frames))


def _pixels_off(frame: Frame, pose: np.ndarray) -> float:
    """Root mean square displacement of the ball's points in a frame's picture, seen from another pose."""
    seen = [project((POINTS - at[:3, 3]) @ at[:3, :3], frame.camera) for at in (frame.camera_to_world, pose)]
    return float(np.sqrt(np.square(seen[0] - seen[1]).sum(-1).mean()))


def test_cameras_that_are_off_are_put_in_their_places(field: Field, scene: Scene) -> None:
    test = [f for f in scene.frames if f.view in scene.split.test]
    off = {(f.sensor, f.view): f for f in _moved(scene, scene.split.test).frames}
    placed = place(field, scene, [off[f.sensor, f.view] for f in test])
    assert set(placed.poses) == {(f.sensor, f.view) for f in test} and set(placed.pixels) == set(scene.split.test)
    for frame in test:
        before = _pixels_off(frame, off[frame.sensor, frame.view].camera_to_world)
        assert before > 0.5 and _pixels_off(frame, placed.poses[frame.sensor, frame.view]) < 0.1
        assert placed.pixels[frame.view] == pytest.approx(before, rel=0.5)


def test_cameras_in_their_places_stay_there(field: Field, scene: Scene) -> None:
    test = [f for f in scene.frames if f.view in scene.split.test]
    placed = place(field, scene, test)
    assert max(_pixels_off(f, placed.poses[f.sensor, f.view]) for f in test) < 0.05 and max(placed.pixels.values()) < 0.05
    assert place(field, scene, []).poses == {}


def _with_truth(field: Field, scene: Scene) -> None:
    """Noise-free light of the test frames, from where they were made."""
    for frame in (f for f in scene.frames if f.view in scene.split.test):
        light = field.render(frame.camera, frame.camera_to_world, geometry=False)
        for folder, name, arrays in (
            (frame.sensor, f"{frame.view:04d}.npz", {"data": np.nan_to_num(light.channels[frame.sensor])}),
            ("masks", f"{frame.view:04d}_{frame.sensor}.npz", {"in_roi": light.valid}),
        ):
            (scene.root / "gt" / folder).mkdir(parents=True, exist_ok=True)
            np.savez(scene.root / "gt" / folder / name, **arrays)


def test_scores_say_what_a_fit_that_moved_its_views_is_worth(field: Field, scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    off = _moved(scene, scene.split.test)
    _with_truth(field, scene)
    plain = evaluate(field, off)
    assert "moved_px" not in plain and "psnr_moved" not in plain["modalities"]["rgb"] and "moved" not in score_text(plain)
    monkeypatch.setattr(field, "corrections", Corrections({v: np.eye(4) for v in scene.split.train}, {}))
    scores, true = evaluate(field, off), evaluate(field, scene)
    assert set(scores["moved_px"]) == {str(v) for v in scene.split.test} and "did not learn from" in score_text(scores)
    for name, found in scores["modalities"].items():
        assert found["psnr"] == plain["modalities"][name]["psnr"] < found["psnr_moved"] - 12
        for of in ("psnr", "psnr_foreground"):
            assert found[f"{of}_moved"] == pytest.approx(true["modalities"][name][of], abs=2.0)  # 48 dB: the noise of the frames
        assert found["psnr_truth"] == plain["modalities"][name]["psnr_truth"] < found["psnr_truth_moved"] - 12
    # views that were learned from have motions of their own
    assert "moved_px" not in evaluate(field, off, views=scene.split.train)
