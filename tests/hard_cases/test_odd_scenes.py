"""Scenes at the edge of what can be fitted: they are fitted, or refused in one sentence."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_scenes import FOCAL, HEIGHT, QUICK, RADIUS, around, look_from, picture, write_scene

from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.fitting import poses as motions
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.trainer import fit
from mmsynth.operations.evaluate import evaluate
from mmsynth.scene.load import load_scene

Row = Callable[[str, str, str], None]


def _fit(folder: Path, poses: dict[str, list[np.ndarray]], steps: int = 40, recipe: Recipe = QUICK, **how: Any) -> Field:
    """A short fit of a scene on disk; every number that it leaves is finite."""
    field = fit(load_scene(write_scene(folder / "scene", poses, **how)), folder / "run", recipe, steps=steps)
    assert all(torch.isfinite(p).all() for p in field.parameters())
    assert field.manifest["skipped_steps"] == 0
    assert all(math.isfinite(x) for x in field.manifest["train_psnr"].values())
    scene = load_scene(folder / "scene")
    frame = scene.frames_of("rgb")[0]
    assert all(
        np.isfinite(c[seen.valid]).all() for seen in [field.render(frame.camera, frame.camera_to_world)] for c in seen.channels.values()
    )
    return field


def _line(count: int) -> list[np.ndarray]:
    """Cameras side by side that all look the same way."""
    out = [look_from((2.6, 0.0, 0.0)) for _ in range(count)]
    for i, pose in enumerate(out):
        pose[1, 3] = 0.2 * (i - count // 2)
    return out


ARRANGEMENTS: dict[str, tuple[list[np.ndarray], str]] = {
    "side by side, parallel": (_line(5), "axes have no common point: a singular system"),
    "one behind the other": ([look_from((2.0 + 0.3 * i, 0.0, 0.0)) for i in range(5)], "all axes are one line: a singular system"),
    "opposite": (
        [look_from(eye) for eye in ((2.6, 0, 0), (-2.6, 0, 0), (2.6, 0, 0.1), (-2.6, 0, 0.1))],
        "a random axis for opposite rotations",
    ),
    "in one place": ([around(8)[0]] * 4, "a baseline of 0: divisions by it"),
    "from above and below": (
        [look_from((0.0, 0.0, z), (1.0, 0.0, 0.0)) for z in (2.6, -2.6, 2.7, -2.7)],
        "no horizon for the frame of polarization",
    ),
    "two views": (around(2) + around(8)[5:6], "one baseline"),
}


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_cameras_in_odd_places(row: Row, tmp_path: Path, name: str) -> None:
    cameras, usual = ARRANGEMENTS[name]
    field = _fit(tmp_path, {"rgb": cameras})
    centre, radius = np.array(field.region.centre), field.region.radius
    assert np.isfinite([*centre, radius]).all() and radius > 0.05
    # most cameras stand outside of the region and look at it
    stands = np.array([pose[:3, 3] for pose in cameras])
    assert np.mean(np.linalg.norm(stands - centre, axis=1) > radius) > 0.5
    row(f"cameras {name}", usual, f"a region of radius {radius:.2g} around ({', '.join(f'{c:.2g}' for c in centre)}), fitted")


def test_one_view_is_refused(row: Row, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected at least 2"):
        _fit(tmp_path, {"rgb": around(1)})
    row("one view", "a fit of nothing: its only view is the test view", "refused in one sentence")


@pytest.mark.parametrize("channels", ["all", "one pixel"])
def test_frames_of_nan_are_refused_by_name(row: Row, tmp_path: Path, channels: str) -> None:
    def spoil(image: np.ndarray) -> np.ndarray:
        out = np.full_like(image, np.nan) if channels == "all" else image.copy()
        out[3, 5] = np.nan
        return out

    with pytest.raises(InputError, match=r"rgb_000\.npy: the pixel in row \d+, column \d+ is not a finite number"):
        _fit(tmp_path, {"rgb": around(6)}, alter={"rgb": spoil}, file_type="npy")
    row(f"a frame with NaN ({channels})", "a loss of NaN some steps later", "refused: file, row and column")


@pytest.mark.parametrize("name", ["black", "transparent"])
def test_a_modality_of_which_nothing_is_seen_is_refused_by_name(row: Row, tmp_path: Path, name: str) -> None:
    hide = {"black": lambda x: 0 * x, "transparent": lambda x: np.concatenate([x, 0 * x[..., :1]], -1)}[name]
    with pytest.raises(InputError, match="all training frames of rgb are black, expected some light"):
        _fit(tmp_path, {"mono": around(6), "rgb": around(6)}, alter={"rgb": hide})
    row(f"a modality that is {name} throughout", "division by its mean: NaN", "refused by name; --modalities leaves it out")


def test_a_modality_that_is_clipped_throughout(row: Row, tmp_path: Path) -> None:
    """It only says "at least": nothing to choose directions by, nothing to divide by."""
    field = _fit(tmp_path, {"mono": around(6), "rgb": around(6)}, alter={"rgb": np.ones_like})
    assert field.view_dependence["rgb"] == 0
    assert "nothing that could be told apart" in field.manifest["needs"]["evidence"]["view_dependence.rgb"]
    row("a modality that is clipped throughout", "errors over no pixels: NaN", "fitted; it tells nothing, and the run says so")


def test_a_modality_with_one_frame(row: Row, tmp_path: Path) -> None:
    field = _fit(tmp_path, {"rgb": around(8), "mono": around(8)[:1]})
    assert field.manifest["needs"]["scarce"] == ("mono",)
    scores = evaluate(field, load_scene(tmp_path / "scene"))["modalities"]
    assert math.isfinite(scores["rgb"]["psnr"])
    row(
        "a modality with one frame",
        "joins in bending the geometry to it (the paper's open problem)",
        "learns its colours from the geometry of the others",
    )


@pytest.mark.parametrize("size", [(32, 1), (1, 24), (1, 1)])
def test_pictures_of_one_row_or_column_or_pixel(row: Row, tmp_path: Path, size: tuple[int, int]) -> None:
    _fit(tmp_path, {"rgb": around(6)}, size=size)
    evaluate(Field.load(tmp_path / "run"), load_scene(tmp_path / "scene"))
    row(f"pictures of {size[0]} x {size[1]}", "a window of SSIM or a pyramid that does not fit", "fitted and evaluated")


@pytest.mark.parametrize("scale", [2.0**10, 2.0**-10, 1000.0, 1e-3, 1e6])
def test_scenes_in_any_unit(row: Row, tmp_path: Path, scale: float) -> None:
    """In millimetres or in kilometres: the same fit. To the last bit where the factor is a power of two."""

    def scaled(factor: float) -> list[np.ndarray]:
        out = around(6)
        for pose in out:
            pose[:3, 3] *= factor
        return out

    plain = _fit(tmp_path / "plain", {"rgb": scaled(1.0)})
    other = _fit(tmp_path / "other", {"rgb": scaled(scale)}, scale=scale)
    assert other.region.radius == pytest.approx(scale * plain.region.radius, rel=1e-6)
    difference = abs(other.manifest["train_psnr"]["rgb"] - plain.manifest["train_psnr"]["rgb"])
    if math.log2(scale).is_integer():
        assert all(torch.equal(a, b) for a, b in zip(plain.parameters(), other.parameters(), strict=True))
    assert difference < 0.3
    row(f"a world {scale:g} times as large", "fixed near planes and learning rates of poses", f"the same fit, {difference:.2f} dB apart")


@pytest.mark.parametrize("steps", [1, 2, 19])
def test_the_shortest_fits(row: Row, tmp_path: Path, steps: int) -> None:
    _fit(tmp_path, {"rgb": around(6)}, steps=steps)
    row(f"a fit of {steps} steps", "schedules that divide by int(0.05 N): division by zero below 20", "a field")


def test_cameras_inside_the_region(row: Row, tmp_path: Path) -> None:
    """Looking outwards from the middle: a panorama."""
    outwards = []
    for i in range(6):
        pose = look_from((math.cos(i), math.sin(i), 0.1))
        pose[:3, :3] = pose[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
        pose[:3, 3] *= 0.05
        outwards.append(pose)
    recipe = Recipe.model_validate({**QUICK.model_dump(), "background": "on"})
    paint = lambda image: 0.3 + 0.2 * np.random.default_rng(0).random(image.shape)
    field = _fit(tmp_path, {"rgb": outwards}, recipe=recipe, alter={"rgb": paint})
    row(
        "cameras inside the region, looking outwards",
        "no interval, or near = far = 0.01: black",
        f"fitted, {field.manifest['train_psnr']['rgb']:.1f} dB",
    )


def test_a_fisheye_that_sees_beside_itself(row: Row, tmp_path: Path) -> None:
    """220 degrees across: half of its picture has no pinhole. The ball fills the middle."""
    near = around(8, 1.4)
    size = (2 * round(math.radians(110) * FOCAL), HEIGHT)
    field = _fit(tmp_path, {"rgb": near}, steps=150, size=size, fisheye=True)
    scene = load_scene(tmp_path / "scene")
    frame = scene.frames_of("rgb", scene.split.test)[0]
    seen = field.render(frame.camera, frame.camera_to_world)
    ball = picture(near[frame.view], 1.0, *size, fisheye=True).any(-1)
    assert frame.camera.lens == "kannala_brandt" and seen.valid.all()
    agree = float(np.mean((seen.opacity > 0.5) == ball))
    depth = float(np.nanmedian(np.abs(seen.depth_ray - _distance(near[frame.view], size))[ball]))
    assert agree > 0.95 and depth < 0.1
    row(
        "a fisheye of 220°", "tan θ: infinite at 90°, a wrong side behind", f"{agree:.1%} of the silhouette, depth within {depth:.2f} radii"
    )


def _distance(pose: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) along the fisheye's rays to the ball, NaN beside it."""
    x = (np.arange(size[0]) - (size[0] - 1) / 2)[None, :] / FOCAL
    y = -(np.arange(size[1]) - (size[1] - 1) / 2)[:, None] / FOCAL
    angle = np.hypot(x, y)
    d = np.stack(np.broadcast_arrays(x * np.sinc(angle / np.pi), y * np.sinc(angle / np.pi), -np.cos(angle)), -1) @ pose[:3, :3].T
    b = d @ pose[:3, 3]
    inside = b**2 - (pose[:3, 3] @ pose[:3, 3] - RADIUS**2)
    return np.where(inside > 0, -b - np.sqrt(np.maximum(inside, 0)), np.nan)


# --- rotations


def test_rotations_by_nothing_and_by_half_a_turn(row: Row) -> None:
    """exp and log of motions: 0 / 0 at no rotation, no axis at half a turn."""
    generator = np.random.default_rng(0)
    worst = 0.0
    for angle in (0.0, 1e-12, 1e-8, 1e-4, 1.0, math.pi - 1e-7, math.pi):
        axis = generator.normal(size=3)
        motion = np.concatenate([angle * axis / np.linalg.norm(axis), generator.normal(size=3)])
        matrix = motions.rigid(motion[None])[0]
        assert np.isfinite(matrix).all() and np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() < 1e-12
        again = motions.rigid(motions.motion_of(matrix[None]))[0]
        worst = max(worst, float(np.abs(again - matrix).max()))
    assert worst < 1e-6
    row("rotations by 0 and by π", "0 / 0, or an axis from random noise", f"exp and log agree to {worst:.0e}")


# --- the same again


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_fit_twice(row: Row, tmp_path: Path, threads: int) -> None:
    before = torch.get_num_threads()
    one = _fit(tmp_path / "one", {"rgb": around(6)}, steps=12)
    try:
        torch.set_num_threads(threads)
        two = _fit(tmp_path / "two", {"rgb": around(6)}, steps=12)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), two.state_dict().values(), strict=True))
    row(
        f"the same fit again, torch on {threads} thread{'s' * (threads > 1)}",
        "atomic additions: 0.2 to 0.3 dB apart",
        "equal to the last bit",
    )
