"""How much of each method: what training frames say, and what is made of it at frames that the field has not seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic import AnalyticField, WrongField, ring_pose, scene_of, sphere
from scipy.optimize import minimize

import mmsynth
from mmsynth.errors import InputError
from mmsynth.operations.conversion.evidence import Evidence, _bounded, gather
from mmsynth.operations.conversion.methods import Chosen, choose, convert_frame
from mmsynth.operations.conversion.predictions import Training
from mmsynth.operations.conversion.windows import opened
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, PosedCamera
from mmsynth.sensors.camera import Camera, ray_map
from mmsynth.sensors.mosaic import channels_of

CAMERA = Camera(48, 36, 52.0, 52.0, 23.1, 17.6, (-0.1, 0.05, 0.001, -0.002))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return scene_of(_field(AnalyticField), tmp_path_factory.mktemp("evidence"), views=7)


def _field(kind: Any) -> Any:
    field = kind(sphere())
    field.cameras = dict.fromkeys(field.cameras, CAMERA)
    return field


def test_a_right_field_is_believed_and_a_wrong_one_is_mended(scene: Any) -> None:
    for source, target in (("rgb", "ms"), ("mono", "pol")):
        right, wrong = (gather(_field(kind), scene, source, target) for kind in (AnalyticField, WrongField))
        assert right is not None and wrong is not None and right.psnr["field"] > 60 and right.psnr["nearest"] < 40
        assert right.weights(0.0, carried=True) == {"field": 1.0}
        found = wrong.weights(0.0, carried=False)
        assert sum(found.values()) == pytest.approx(1.0) and max(found, key=lambda name: found[name]) != "field"


def test_weights_leave_polarization_to_the_field(scene: Any) -> None:
    """Whatever part of linear and nearest is taken, DoLP and AoLP are those of the field."""
    field, frame = _field(WrongField), scene.frames_of("mono")[6]
    found = gather(field, scene, "mono", "pol")
    assert found is not None
    forced = Evidence(**{**vars(found), "gram": np.eye(3), "product": np.full(3, 0.25)})
    raw, view = opened(field, frame)
    how: Any = {"source": "mono", "target": "pol"}
    mixed = convert_frame(field, raw, view, method=Chosen("auto", found.training, forced), **how)
    assert mixed.weights == pytest.approx({"field": 1 - 0.5 - 0.25 / 0.6, "linear": 0.25, "nearest": 0.25, "ratio": 0.25 / 0.6}, abs=1e-4)
    assert mixed.stokes is not None
    alone = convert_frame(field, raw, view, method="field", **how)
    lit = alone.stokes[..., 0] > 0.1  # type: ignore[index]
    ratio = mixed.stokes[..., :1] / alone.stokes[..., :1]  # type: ignore[index]
    np.testing.assert_allclose(mixed.stokes[lit], (ratio * alone.stokes)[lit], atol=1e-5)  # type: ignore[operator]


def test_weights_are_the_bounded_least_squares() -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        apart, left = random.normal(size=(3, 50)), random.normal(size=50)
        left = left + random.normal(size=3) @ apart
        gram, product = apart @ apart.T / 50, apart @ left / 50
        cost = lambda w, g=gram, h=product: w @ g @ w - 2 * h @ w
        bounds, total = [(0, None)] * 3, {"type": "ineq", "fun": lambda w: 1 - w.sum()}
        best = minimize(cost, np.full(3, 0.2), bounds=bounds, constraints=[total], method="SLSQP", options={"ftol": 1e-12})
        found = _bounded(gram, product)
        assert found.min() >= 0 and found.sum() <= 1 + 1e-6 and cost(found) == pytest.approx(best.fun, abs=1e-5)


def test_a_field_that_proves_worse_is_believed_less() -> None:
    """Independent predictors of one error: with e² more of it, w = e² / (e² + theirs) of what does without the field."""
    known = Evidence(
        "rgb", "ms", Training(np.zeros((4, 9)), ()), (0,), {}, ("linear",), np.array([[1.0 + 0.1]]), np.array([0.1]), 0.1, 0.01, False, {}
    )  # fmt: skip
    assert known.weights(0.1, carried=True)["linear"] == pytest.approx(0.1 / 1.1, abs=1e-4)
    assert known.weights(0.05, carried=True) == pytest.approx(known.weights(0.1, carried=True), abs=1e-4)  # less than usual proves nothing
    assert known.weights(0.3, carried=True)["linear"] == pytest.approx(0.9 / 1.9, abs=1e-4)


def test_nearest_is_a_frame_carried_over_and_not_the_one_asked_for(scene: Any) -> None:
    field = _field(AnalyticField)
    mono = scene.frames_of("mono")[2]
    chosen = choose(field, scene, "rgb", "mono", "nearest")
    raw, view = load_frame(field.sensors["rgb"], scene.frames_of("rgb")[2])[0], PosedCamera(CAMERA, mono.camera_to_world)
    how: Any = {"source": "rgb", "target": "mono", "method": chosen, "seen_by": view}
    own = convert_frame(field, raw, PosedCamera(CAMERA, scene.frames_of("rgb")[2].camera_to_world), **how)
    np.testing.assert_allclose(own.values[own.guided], load_frame(field.sensors["mono"], mono)[0][own.guided], atol=1e-3)
    other = convert_frame(field, raw, PosedCamera(CAMERA, scene.frames_of("rgb")[2].camera_to_world), left_out=2, **how)
    assert 0.1 < other.guided.mean() < own.guided.mean()
    kept = field.render(CAMERA, mono.camera_to_world, ["mono"]).channels["mono"]
    np.testing.assert_array_equal(other.values[other.valid & ~other.guided], kept[other.valid & ~other.guided])


def test_a_window_is_the_frame_there(scene: Any) -> None:
    field = _field(AnalyticField)
    frame: Frame = scene.frames_of("ms")[1]
    whole, part = opened(field, frame)[0], opened(field, frame, (20, 20))
    assert part[0].shape[:2] == (part[1].camera.height, part[1].camera.width) and max(part[0].shape) <= 20
    left, top = round(CAMERA.cx - part[1].camera.cx), round(CAMERA.cy - part[1].camera.cy)
    assert left % 3 == top % 3 == 0  # the mosaic of ms
    np.testing.assert_array_equal(part[0], whole[top : top + part[0].shape[0], left : left + part[0].shape[1]])
    np.testing.assert_allclose(ray_map(part[1].camera)[0], ray_map(CAMERA)[0][top : top + 20, left : left + 20], atol=1e-9)
    assert channels_of(part[0], field.sensors["ms"].mosaic).shape[-1] == 9


def test_tensors_with_a_scene(scene: Any) -> None:
    field = _field(WrongField)
    raw = load_frame(field.sensors["rgb"], scene.frames_of("rgb")[6])[0]
    frames, poses = torch.from_numpy(raw)[None, None], torch.from_numpy(ring_pose(6, 7))[None]
    found = mmsynth.convert(field, frames, source="rgb", target="ms", poses=poses, scene=scene)
    assert found.method == "auto" and sum(found.weights[0].values()) == pytest.approx(1.0)
    assert found.evidence is not None and set(found.evidence.views) <= set(scene.split.train)
    alone = mmsynth.convert(field, frames, source="rgb", target="ms", poses=poses)
    assert alone.method == "guided" and alone.evidence is None and alone.weights == ({"guided": 1.0},)


def test_without_views_in_common_the_kind_decides(tmp_path: Path) -> None:
    field = _field(AnalyticField)
    scene = scene_of(field, tmp_path, views=4, truth=False)
    apart: Any = type(scene)(**{**vars(scene), "frames": tuple(f for f in scene.frames if (f.sensor == "rgb") == (f.view < 2))})
    assert gather(field, apart, "rgb", "ms") is None and choose(field, apart, "rgb", "ms").method == "guided"
    assert gather(field, scene, "rgb", "rgb") is None  # a frame says nothing about itself
    none: Any = type(scene)(**{**vars(scene), "frames": tuple(f for f in scene.frames if f.sensor == "rgb")})
    with pytest.raises(InputError, match="no training frames of ms"):
        choose(field, none, "rgb", "ms", "nearest")
