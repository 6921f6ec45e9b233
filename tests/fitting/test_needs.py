"""What a fit finds that its scene needs, on scenes whose needs are known: a ball in a black room, and one in a painted room."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mmsynth.field.storage import load_field, save_field
from mmsynth.fitting import decisions
from mmsynth.fitting.measurements import load_measurements
from mmsynth.fitting.needs import SAMPLES_ON_GPU, Needs, assess, expected_rays
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.schedule import sampling_at
from mmsynth.fitting.trainer import Trainer
from mmsynth.scene.images import load_frame
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene, keep_frames

SIZE, FOCAL, VIEWS = 36, 48.0, 14
SMALL = {
    "sampling.samples_per_step": 4096, "sampling.samples_growth": 1.0,
    "sampling.initial_rays": 256, "surface.max_rows_log2": 12, "radiance.max_rows_log2": 13,
    "sampling.occupancy_resolution": 24, "loss.eikonal_points": 128, "radiance.hidden_width": 32, "schedule.view_dependence_from": 0.2,
    # fits as short as these use directions for what is wrong elsewhere: over eight of them, degree 0 cost a diffuse ball up to 6.6 %
    "radiance.view_dependence_min_improvement": 0.1,
}  # fmt: skip


def _pose(angle: float, height: float) -> np.ndarray:
    """OpenGL camera_to_world that looks at the origin."""
    eye = np.array([2.6 * np.cos(angle), 2.6 * np.sin(angle), height])
    back = eye / np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], 1)
    return pose


def _picture(pose: np.ndarray, gloss: float, room: float) -> np.ndarray:
    """A ball of radius 0.7 with bands of colour, a highlight and a painted room of the given brightness."""
    v, u = np.mgrid[:SIZE, :SIZE]
    local = np.stack([(u - (SIZE - 1) / 2) / FOCAL, -(v - (SIZE - 1) / 2) / FOCAL, -np.ones_like(u, float)], -1)
    d = local @ pose[:3, :3].T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    o = pose[:3, 3]
    b = d @ o
    inside = b**2 - (o @ o - 0.7**2)
    hit = inside > 0
    n = (o + d * (-b - np.sqrt(np.maximum(inside, 0)))[..., None]) / 0.7
    bands = np.stack([0.4 + 0.25 * np.sin(4 * n[..., 0]), 0.4 + 0.25 * np.sin(4 * n[..., 1] + 1), 0.35 + 0.2 * np.cos(4 * n[..., 2])], -1)
    light = np.array([0.5, 0.2, 0.84])
    mirrored = d - 2 * (d * n).sum(-1, keepdims=True) * n
    ball = bands + gloss * np.clip(mirrored @ light, 0, 1)[..., None] ** 3
    return np.where(hit[..., None], ball, room * (0.35 + 0.2 * np.sin(5 * d)))


def _scene(folder: Path, gloss: float = 0.0, room: float = 0.0, gains: np.ndarray | None = None) -> Scene:
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for i in range(VIEWS):
        pose = _pose(2 * np.pi * i / VIEWS, 0.5 + 0.9 * (i % 3))
        picture = _picture(pose, gloss, room) * (1.0 if gains is None else gains[i])
        cv2.imwrite(str(folder / f"{i:03}.png"), np.rint(np.clip(picture, 0, 1)[..., ::-1] * 65535).astype(np.uint16))
        frames.append({"file_path": f"{i:03}.png", "transform_matrix": pose.tolist()})
    intrinsics = {"w": SIZE, "h": SIZE, "fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))
    return load_scene(folder)


def _fitted(scene: Scene, steps: int = 260, **recipe: object) -> Trainer:
    trainer = Trainer(scene, Recipe().with_changes({**SMALL, **recipe}), steps, None, 0, "cpu")
    while trainer.progress < 1:
        trainer.run_step()
    return trainer


def test_a_gpu_is_expected_to_see_as_many_rays_as_its_steps_have() -> None:
    """By a processor's number a full-size scene would be learned as coarsely there."""
    recipe = Recipe().with_changes({"sampling.samples_per_step": 1 << 14})
    assert expected_rays(recipe, 100, None, on_gpu=True) / expected_rays(recipe, 100, None) == SAMPLES_ON_GPU / (1 << 14)
    large = recipe.with_changes({"sampling.samples_per_step": 1 << 20})
    assert expected_rays(large, 100, None, on_gpu=True) == expected_rays(large, 100, None)
    assert expected_rays(recipe, None, 60.0, on_gpu=True) > 100 * expected_rays(recipe, None, 60.0)


def test_a_diffuse_ball_in_the_dark_gets_nothing_superfluous(tmp_path: Path) -> None:
    trainer = _fitted(_scene(tmp_path / "s"))
    assert not trainer.needs.design.background and trainer.field.surface.grid.extent == 1.0
    assert trainer.field.view_dependence == {"rgb": 0}, trainer.choices
    assert trainer.gains() == {}, trainer.choices
    assert trainer.needs.sparse == ()
    assert trainer.field.far_light is None and trainer.choices["far_light"].why.startswith("off")
    assert trainer.field.shader.heads.out_features == 3  # no tensor head
    assert trainer.choices["tensor_head"].why.startswith("off")
    assert trainer.report().psnr["rgb"] > 25  # the decisions are about a fit that works


def test_a_glossy_ball_in_a_painted_room_gets_what_it_needs(tmp_path: Path) -> None:
    trainer = _fitted(_scene(tmp_path / "s", gloss=0.5, room=1.0))
    assert trainer.needs.design.background and trainer.field.surface.grid.extent == 2.0
    assert trainer.field.view_dependence["rgb"] > 0, trainer.choices
    assert trainer.gains() == {}, trainer.choices


def test_few_views_of_a_room_have_its_walls_made_smooth(tmp_path: Path) -> None:
    """Not many views, and not where nothing outside the region is modelled; it changes a fit, and one that goes on."""
    room = _scene(tmp_path / "room", room=1.0)
    few = keep_frames(room, {"rgb": 8})
    for views, said in ((8, "on: 8"), (12, "on: 12"), (13, "off: 13")):
        assert _needs(keep_frames(room, {"rgb": views})).choices["smooth"].why.startswith(said)
    assert "outside of the region" in _needs(_scene(tmp_path / "dark")).choices["smooth"].why
    assert _needs(few).smooth and not _needs(few, **{"loss.smooth_weight": 0.0}).smooth
    fits = [_fitted(few, 12, **{"loss.smooth_weight": weight}).field.surface.hidden for weight in (0.0, 0.01, 0.01)]
    assert not torch.equal(fits[0], fits[1]) and torch.equal(fits[1], fits[2])
    first, second = (Trainer(few, Recipe().with_changes(SMALL), 12, None, 0, "cpu") for _ in range(2))
    for _ in range(6):
        first.run_step()
    second.restore(first.checkpoint())
    while second.progress < 1:
        second.run_step()
    assert torch.equal(second.field.surface.hidden, fits[1])


@pytest.mark.parametrize(("views", "degree"), [(3, 0), (4, 1), (8, 1), (9, 2), (12, 2), (13, 3)])
def test_few_views_have_no_more_harmonics_of_direction_than_they_are(tmp_path: Path, views: int, degree: int) -> None:
    few = keep_frames(_scene(tmp_path / "room", gloss=0.5, room=1.0), {"rgb": views})
    needs = _needs(few)
    assert needs.directions == degree and needs.few == (views <= 12)
    assert needs.choices["directions"].changed == needs.few
    assert _needs(few, **{"radiance.view_dependence": 3}).directions == 3


def test_few_views_have_no_more_harmonics_even_where_the_error_asks_for_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the recipe asks for is done."""
    few = keep_frames(_scene(tmp_path / "room", gloss=0.5, room=1.0), {"rgb": 8})
    monkeypatch.setattr(decisions, "degree_needed", lambda errors, worth: len(errors) - 1)
    asked = {"radiance.view_dependence": 3}
    assert _fitted(few, 40).field.view_dependence["rgb"] == 1
    assert _fitted(few, 40, **asked).field.view_dependence["rgb"] == 3


def _past_the_ball(trainer: Trainer, scene: Scene) -> float:
    """Mean absolute error of the test views where no ball is."""
    errors = []
    for frame in scene.frames_of("rgb", scene.split.test):
        truth, _ = load_frame(scene.sensors["rgb"], frame)
        seen = trainer.field.render(frame.camera, frame.camera_to_world)
        assert np.isfinite(seen.channels["rgb"]).all()
        errors.append(np.abs(seen.channels["rgb"] - truth)[seen.opacity < 0.1].mean())
    return float(np.mean(errors))


def test_a_dim_room_is_a_colour_per_direction_and_not_a_surface(tmp_path: Path) -> None:
    scene = _scene(tmp_path / "s", room=0.2)
    trainer, without = _fitted(scene), _fitted(scene, **{"radiance.far_light": "off"})
    assert trainer.needs.design.far_light and not trainer.needs.design.background, trainer.choices
    assert without.field.far_light is None and "asked for by the recipe" in without.choices["far_light"].why
    assert _past_the_ball(trainer, scene) < 0.5 * _past_the_ball(without, scene)
    # and it is still known after it was stored
    trainer.field.sampling = sampling_at(1.0, trainer.recipe, trainer.needs)
    save_field(trainer.field, tmp_path)
    frame = scene.frames_of("rgb", scene.split.test)[0]
    before, after = (f.render(frame.camera, frame.camera_to_world).channels["rgb"] for f in (trainer.field, load_field(tmp_path)))
    np.testing.assert_array_equal(before, after)


def test_frames_of_different_exposure_get_gains_and_the_gains_are_right(tmp_path: Path) -> None:
    gains = np.exp(0.25 * np.sin(1.7 * np.arange(VIEWS)))
    scene = _scene(tmp_path / "s", gains=gains)
    trainer = _fitted(
        scene, **{"schedule.decide_at": 0.3, "schedule.learning_rate_exposure": 5e-3, "surface.initial_radius": 0.15}
    )  # near the ball: a short fit
    found = np.array(trainer.gains()["rgb"])
    true = np.array([gains[f.view] for f in scene.frames_of("rgb", scene.split.train)])
    true /= np.exp(np.log(true).mean())
    error = np.sqrt(np.square(np.log(found / true)).mean())
    assert error < 0.4 * np.sqrt(np.square(np.log(true)).mean()), (found, true)
    forced = _fitted(scene, steps=40, **{"radiance.exposure": "off"})
    assert forced.gains() == {} and "asked for by the recipe" in forced.choices["exposure"].why


@pytest.mark.parametrize("degree", [0, 2])
def test_the_recipe_can_force_the_degree_of_view_dependence(tmp_path: Path, degree: int) -> None:
    trainer = _fitted(_scene(tmp_path / "s"), steps=20, **{"radiance.view_dependence": degree})
    assert trainer.field.view_dependence == {"rgb": degree}
    assert "asked for by the recipe" in trainer.choices["view_dependence.rgb"].why


def _needs(scene: Scene, **recipe: object) -> Needs:
    return assess(scene, load_measurements(scene), Recipe().with_changes({**SMALL, **recipe}), 0, 1e6)


def test_a_modality_with_few_frames_is_sparse() -> None:
    from mmsynth.packaged import data_folder

    scene = load_scene(data_folder("example_scene"))
    assert _needs(scene).sparse == ()
    few = _needs(keep_frames(scene, {"pol": 2}))
    assert few.sparse == ("pol",) and 0 < few.share["pol"] < 0.5 and few.share["rgb"] == 1.0
    assert _needs(keep_frames(scene, {"pol": 2}), **{"sampling.sparse_below": 0.0}).sparse == ()


def test_a_sparse_modality_leaves_geometry_and_appearance_alone() -> None:
    from mmsynth.packaged import data_folder

    scene = keep_frames(load_scene(data_folder("example_scene"), modalities=["rgb", "pol"]), {"rgb": 1})
    trainer = Trainer(scene, Recipe().with_changes({**SMALL, "loss.eikonal_weight": 0.0}), 10, None, 0, "cpu")
    assert trainer.needs.sparse == ("rgb",)
    weights = trainer.field.shader.heads.weight
    before = weights.detach().clone()
    tables = {n: p.detach().clone() for n, p in trainer.field.named_parameters() if n.endswith(".table")}
    # without the plentiful modality nothing may move but the sparse one's own colours
    trainer.needs.share.pop("pol")
    trainer.run_step()
    for name, p in trainer.field.named_parameters():
        if name in tables:
            assert bool((p == tables[name]).all()), name
    rows = trainer.field.shader.columns
    assert bool((weights[rows["rgb"]] != before[rows["rgb"]]).any())
    assert bool((weights[rows["pol"]] == before[rows["pol"]]).all())


def test_a_cell_of_the_surface_is_seen_by_enough_measurements(tmp_path: Path) -> None:
    scene = _scene(tmp_path / "plain")
    measurements = load_measurements(scene)
    pixels = sum(m.pixels for m in measurements.values())
    cells_per_pixel = 32.0  # finer than pixels, so that only the measurements limit it

    def at(measurements_per_cell: float) -> Needs:
        changes = {"surface.cells_per_pixel": cells_per_pixel, "surface.measurements_per_cell": measurements_per_cell}
        return assess(scene, measurements, Recipe().with_changes(changes), 0, 1e9)

    enough, few = (at(m) for m in (1e-3, 1e-2))
    free = at(1e-9)
    assert 6 * few.design.surface_finest**2 * 1e-2 == pytest.approx(pixels, rel=0.02)
    assert 6 * enough.design.surface_finest**2 * 1e-3 >= pixels or enough.design.surface_finest == 1024
    # what is coarser is softer, in proportion
    finest = 2 * cells_per_pixel * (2 if free.design.background else 1) / few.footprint
    wanted = free.sharpness_end * few.design.surface_finest / finest
    assert few.sharpness_end == pytest.approx(wanted, rel=0.02)
    assert "measurements of each" in few.choices["resolution"].why and "measurements of each" not in free.choices["resolution"].why
    # small pictures show large things: down to a grid of 128 cells, not below
    assert at(1e6).design.surface_finest == 128
