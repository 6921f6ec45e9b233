"""Scenes at the edge of what can be fitted: they are fitted, or refused in one sentence."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from few_looks import few_looks
from skimage.metrics import structural_similarity
from small_scenes import FOCAL, HEIGHT, QUICK, RADIUS, WIDTH, around, look_from, picture, write_scene

from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.field.rendering import FREE
from mmsynth.field.storage import load_field
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import fit
from mmsynth.operations.evaluation.evaluate import evaluate
from mmsynth.scene.load import load_scene
from mmsynth.scene.motion import matrix_to_motion, motion_to_matrix
from mmsynth.scene.scene import Scene
from mmsynth.sensors.camera import Camera, ray_map

Row = Callable[[str, str, str], None]


def _fit(folder: Path, poses: dict[str, list[np.ndarray]], steps: int = 40, recipe: Recipe = QUICK, **how: Any) -> Field:
    """A short fit of a scene on disk; every number that it leaves is finite."""
    field = fit(load_scene(write_scene(folder / "scene", poses, **how)), folder / "run", recipe=recipe, steps=steps)
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


def _focus_of_attention(poses: list[np.ndarray]) -> str:
    """nerfstudio's: the point nearest to all optical axes, by the inverse of the mean of I - d dᵀ."""
    axes = torch.tensor(np.stack([pose[:3, 2:3] for pose in poses]), dtype=torch.float32)
    across = (torch.eye(3) - axes * axes.mT).mean(0)
    with pytest.raises(torch.linalg.LinAlgError):
        torch.linalg.inv(across)
    return f"nerfstudio's point nearest to the axes: a singular matrix of rank {torch.linalg.matrix_rank(across)}"


def _rotation_matrix(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """nerfstudio's first, and MultimodalStudio's: turns unit vector a to b."""
    v, c = torch.linalg.cross(a, b), torch.dot(a, b)
    if c < -1 + 1e-8:
        noisy = a + (torch.rand(3) - 0.5) * 0.01
        return _rotation_matrix(noisy / noisy.norm(), b)
    k = torch.tensor([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return torch.eye(3) + k + k @ k * ((1 - c) / (v.norm() ** 2 + 1e-8))


def _turned_upright(poses: list[np.ndarray]) -> str:
    """Both turn the world until the mean of the cameras' up vectors is z. No noise is added: in float32 -1 is not less than -1 + 1e-8."""
    up = torch.tensor(np.mean([pose[:3, 1] for pose in poses], 0), dtype=torch.float32)
    after = _rotation_matrix(up / up.norm(), torch.tensor([0.0, 0.0, 1.0])) @ up
    off = math.degrees(math.atan2(float(after[:2].norm()), float(after[2])))
    assert off > 90
    return f"nerfstudio turns the mean of their up vectors to z: still {off:.0f}° off"


def _unit_poses(poses: list[np.ndarray]) -> str:
    """nerfstudio's scale, 1 / max |t - mean t|."""
    stands = torch.tensor(np.stack([pose[:3, 3] for pose in poses]), dtype=torch.float32)
    scale = 1.0 / (stands - stands.mean(0)).abs().max()
    assert not scale < 1e6
    return f"nerfstudio's scale 1 / max abs(t - mean t): {float(scale):.2g}"


def _horizon(poses: list[np.ndarray]) -> str:
    """MultimodalStudio's frame of polarization: d x z, divided by its length."""
    n = np.cross([-pose[:3, 2] for pose in poses], [0.0, 0.0, 1.0])
    with np.errstate(invalid="ignore"):
        lost = np.isnan(n / np.linalg.norm(n, axis=1, keepdims=True)).any(1)
    assert lost.all()
    return f"d x z over its length, the frame of polarization: NaN on the axes of {lost.sum()} of {len(lost)} cameras"


ARRANGEMENTS: dict[str, tuple[list[np.ndarray], Callable[[list[np.ndarray]], str] | None]] = {
    "side by side, parallel": (_line(5), _focus_of_attention),
    "one behind the other": ([look_from((2.0 + 0.3 * i, 0.0, 0.0)) for i in range(5)], _focus_of_attention),
    "opposite": ([look_from(eye) for eye in ((2.6, 0, 0), (-2.6, 0, 0), (2.6, 0, 0.1), (-2.6, 0, 0.1))], None),
    "upside down": ([look_from((2.6 * math.cos(i), 2.6 * math.sin(i), 0.0), (0.0, 0.0, -1.0)) for i in range(6)], _turned_upright),
    "in one place": ([around(8)[0]] * 4, _unit_poses),
    "from above and below": ([look_from((0.0, 0.0, z), (1.0, 0.0, 0.0)) for z in (2.6, -2.6, 2.7, -2.7)], _horizon),
    "two views": (around(2) + around(8)[5:6], None),
}


@pytest.mark.usefixtures("decided_by_few_rays")
@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_cameras_in_odd_places(row: Row, tmp_path: Path, name: str) -> None:
    cameras, usual = ARRANGEMENTS[name]
    field = _fit(tmp_path, {"rgb": cameras})
    centre, radius = np.array(field.region.centre), field.region.radius
    assert np.isfinite([*centre, radius]).all() and radius > 0.05
    # most cameras stand outside of the region and look at it
    stands = np.array([pose[:3, 3] for pose in cameras])
    assert np.mean(np.linalg.norm(stands - centre, axis=1) > radius) > 0.5
    # again the same, in the input's own frame: nothing is turned
    again = load_scene(tmp_path / "scene")
    assert again.region == field.region
    np.testing.assert_allclose([f.camera_to_world[:3, 3] for f in again.frames_of("rgb")], stands, atol=1e-12)
    if usual:
        row(
            f"cameras {name}",
            usual(cameras),
            f"a region of radius {radius:.2g} around ({', '.join(f'{c + 0.0:.2g}' for c in centre.round(9))}), fitted",
        )


def test_one_view_is_refused(row: Row, tmp_path: Path) -> None:
    pictures = torch.from_numpy(np.stack([picture(pose) for pose in around(1)]))
    train = torch.arange(len(pictures)) % 8 != 0
    usual = float(pictures[train].mean())
    assert math.isnan(usual)
    with pytest.raises(InputError, match="expected at least 2"):
        _fit(tmp_path, {"rgb": around(1)})
    row("one view", f"nerfstudio keeps every eighth for tests: {train.sum()} to learn from, a mean of NaN", "refused in one sentence")


def _weights_after_a_step(image: np.ndarray) -> float:
    """torch's Adam on the mean squared error of a small network and the picture: the share of weights that are NaN."""
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(2, 16), torch.nn.ReLU(), torch.nn.Linear(16, 3))
    places = torch.from_numpy(np.argwhere(np.ones(image.shape[:2]))).float()
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    torch.nn.functional.mse_loss(network(places), torch.from_numpy(image).reshape(-1, 3).float()).backward()
    optimiser.step()
    return float(torch.cat([p.detach().flatten() for p in network.parameters()]).isnan().float().mean())


@pytest.mark.parametrize("channels", ["all", "one pixel"])
def test_frames_of_nan_are_refused_by_name(row: Row, tmp_path: Path, channels: str) -> None:
    def spoil(image: np.ndarray) -> np.ndarray:
        out = np.full_like(image, np.nan) if channels == "all" else image.copy()
        out[3, 5] = np.nan
        return out

    with pytest.raises(InputError, match=r"rgb_000\.npy: the pixel in row \d+, column \d+ is not a finite number"):
        _fit(tmp_path, {"rgb": around(6)}, alter={"rgb": spoil}, file_type="npy")
    usual = _weights_after_a_step(spoil(picture(around(6)[0])))
    assert usual > 0.5
    row(f"a frame with NaN ({channels})", f"a step of Adam on it: {usual:.0%} of the weights NaN", "refused: file, row and column")


@pytest.mark.parametrize("name", ["black", "transparent"])
def test_a_modality_of_which_nothing_is_seen_is_refused_by_name(row: Row, tmp_path: Path, name: str) -> None:
    hide = {"black": lambda x: 0 * x, "transparent": lambda x: np.concatenate([x, 0 * x[..., :1]], -1)}[name]
    with pytest.raises(InputError, match="all training frames of rgb are black, expected some light"):
        _fit(tmp_path, {"mono": around(6), "rgb": around(6)}, alter={"rgb": hide})
    seen = torch.from_numpy(hide(picture(around(6)[0])))
    mean = seen.mean() if name == "black" else (seen[..., :3] * seen[..., 3:]).sum() / seen[..., 3:].sum()
    usual = float((seen[..., :3] / mean).isnan().float().mean())
    assert usual == 1
    row(f"a modality that is {name} throughout", f"divided by its mean: {usual:.0%} NaN", "refused by name; --modalities leaves it out")


def test_a_modality_that_is_clipped_throughout(row: Row, tmp_path: Path) -> None:
    """It only says "at least": nothing to choose directions by, nothing to divide by."""
    field = _fit(tmp_path, {"mono": around(6), "rgb": around(6)}, alter={"rgb": np.ones_like})
    assert field.view_dependence["rgb"] == field.view_dependence["mono"]  # that it asks for itself is 0
    assert "nothing that could be told apart" in field.manifest["needs"]["choices"]["view_dependence.rgb"]["why"]
    measured = torch.ones(HEIGHT, WIDTH, 3)
    usual = float((measured[measured < 1.0] - 0.5).square().mean())
    assert math.isnan(usual)
    row(
        "a modality that is clipped throughout",
        "mean error of what is not clipped: NaN",
        "fitted; it tells nothing, and the run says so",
    )


@pytest.mark.usefixtures("decided_by_few_rays")
def test_a_modality_with_one_frame(row: Row, tmp_path: Path) -> None:
    """The frame does not stand where its pose says: it sees the ball half as large. What do test views of the others lose by it?"""
    poses = {"rgb": around(12), "mono": around(12)[1:2]}
    wrong = {"mono": lambda _: picture(poses["mono"][0], 0.5).mean(-1)}
    psnr: dict[str, list[float]] = {"joint": [], "ours": []}
    for seed in range(3):
        for name, below in (("joint", 0.0), ("ours", QUICK.sampling.sparse_below)):
            folder = write_scene(tmp_path / "scene", poses, alter=wrong)
            recipe = QUICK.with_changes({"sampling.sparse_below": below})
            field = fit(load_scene(folder), tmp_path / "run", recipe=recipe, steps=200, seed=seed)
            assert field.manifest["needs"]["sparse"] == (("mono",) if name == "ours" else ())
            psnr[name].append(evaluate(field, load_scene(folder))["modalities"]["rgb"]["psnr"])
    gains = np.subtract(psnr["ours"], psnr["joint"])
    assert gains.min() > 0 and gains.mean() > 1
    row(
        "a modality with one frame, its pose wrong",
        f"all learn the geometry: test views of the others at {np.mean(psnr['joint']):.1f} dB (three seeds)",
        f"it learns its colours from theirs: {np.mean(psnr['ours']):.1f} dB, {gains.min():.1f} to {gains.max():.1f} more",
    )


@pytest.mark.usefixtures("decided_by_few_rays")
@pytest.mark.parametrize("size", [(32, 1), (1, 24), (1, 1)])
def test_pictures_of_one_row_or_column_or_pixel(row: Row, tmp_path: Path, size: tuple[int, int]) -> None:
    _fit(tmp_path, {"rgb": around(6)}, size=size)
    evaluate(load_field(tmp_path / "run"), load_scene(tmp_path / "scene"))
    seen = picture(around(6)[0], 1.0, *size)
    with pytest.raises(ValueError, match="win_size exceeds image extent"):
        structural_similarity(seen, seen, data_range=1.0, channel_axis=-1)
    row(f"pictures of {size[0]} x {size[1]}", "scikit-image's SSIM: ValueError, its window does not fit", "fitted and evaluated")


def _between_planes(scene: Scene, scale: float) -> float:
    """Share of the rays to the ball that meet it between nerfstudio's near and far planes, the poses as they are."""
    depths = []
    for frame in scene.frames_of("rgb"):
        o, along = frame.camera_to_world[:3, 3], ray_map(frame.camera)[0] @ frame.camera_to_world[:3, :3].T @ frame.camera_to_world[:3, 3]
        inside = along**2 - o @ o + (scale * RADIUS) ** 2
        depths.append(-along[inside > 0] - np.sqrt(inside[inside > 0]))
    return float(np.mean([np.mean((d > 0.05) & (d < 1000.0)) for d in depths]))


@pytest.fixture(scope="module")
def in_metres(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Field]:
    folder = tmp_path_factory.mktemp("plain")
    with pytest.MonkeyPatch.context() as patch:
        few_looks(patch)
        return folder / "scene", _fit(folder, {"rgb": around(6)})


@pytest.mark.usefixtures("decided_by_few_rays")
@pytest.mark.parametrize("scale", [2.0**10, 2.0**-10, 1000.0, 1e-3, 1e6])
def test_scenes_in_any_unit(row: Row, tmp_path: Path, in_metres: tuple[Path, Field], scale: float) -> None:
    """In millimetres or in kilometres: the same fit. To the last bit where the factor is a power of two."""
    poses, (folder, plain) = around(6), in_metres
    for pose in poses:
        pose[:3, 3] *= scale
    other = _fit(tmp_path / "other", {"rgb": poses}, scale=scale)
    assert other.region.radius == pytest.approx(scale * plain.region.radius, rel=1e-6)
    difference = abs(other.manifest["train_psnr"]["rgb"] - plain.manifest["train_psnr"]["rgb"])
    if math.log2(scale).is_integer():
        assert all(torch.equal(a, b) for a, b in zip(plain.parameters(), other.parameters(), strict=True))
    assert difference < 0.3
    usual = _between_planes(load_scene(tmp_path / "other" / "scene"), scale)
    assert _between_planes(load_scene(folder), 1.0) == 1 and usual < 0.5
    row(
        f"a world {scale:g} times as large",
        f"nerfstudio's planes at 0.05 and 1000, poses as they are: {usual:.0%} of the rays meet the ball between them",
        f"the same fit, {difference:.2f} dB apart",
    )


@pytest.mark.usefixtures("decided_by_few_rays")
@pytest.mark.parametrize("steps", [1, 2, 19])
def test_the_shortest_fits(row: Row, tmp_path: Path, steps: int) -> None:
    _fit(tmp_path, {"rgb": around(6)}, steps=steps)
    annealing = lambda step: min(1.0, step / int(0.05 * steps))
    with pytest.raises(ZeroDivisionError):
        annealing(0)
    row(f"a fit of {steps} steps", "MultimodalStudio's step / int(0.05 N): ZeroDivisionError", "a field")


def test_cameras_inside_the_region(row: Row, tmp_path: Path) -> None:
    """Looking outwards from the middle: a panorama."""
    outwards = []
    for i in range(6):
        pose = look_from((math.cos(i), math.sin(i), 0.1))
        pose[:3, :3] = pose[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
        pose[:3, 3] *= 0.05
        outwards.append(pose)
    recipe = QUICK.with_changes({"surface.background": "on"})
    paint = lambda image: 0.3 + 0.2 * np.random.default_rng(0).random(image.shape)
    field = _fit(tmp_path, {"rgb": outwards}, recipe=recipe, alter={"rgb": paint})
    # NeuS, near_far_from_sphere: one radius before and one behind the point nearest to the centre
    stands = (np.array([pose[:3, 3] for pose in outwards]) - field.region.centre) / field.region.radius
    middle = -np.einsum("ni,ni->n", stands, [-pose[:3, 2] for pose in outwards])
    behind = float(np.mean(middle[:, None] + np.linspace(-1, 1, 64) < 0))
    assert behind > 0.4
    row(
        "cameras inside the region, looking outwards",
        f"NeuS, near = -o·d - 1: {behind:.0%} of 64 samples are behind the camera",
        f"fitted, {field.manifest['train_psnr']['rgb']:.1f} dB",
    )


@pytest.mark.usefixtures("decided_by_few_rays")
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
    x, y = ((np.arange(n) - (n - 1) / 2) / FOCAL for n in size)
    theta = np.hypot(x[None, :], y[:, None])
    usual = np.stack([np.tan(theta), np.ones_like(theta)], -1) / np.hypot(np.tan(theta), 1.0)[..., None]
    off = np.degrees(np.arccos(np.clip(usual[..., 0] * np.sin(theta) + usual[..., 1] * np.cos(theta), -1, 1)))
    assert off[HEIGHT // 2, 0] > 179 and (off > 90).mean() > 0.1
    row(
        "a fisheye of 220°",
        f"rays (tan θ, 1): {off[HEIGHT // 2, 0]:.0f}° off at the picture's side, for {(off > 90).mean():.0%} of its pixels",
        f"{agree:.1%} of the silhouette, depth within {depth:.2f} radii",
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


def _rodrigues(turn: np.ndarray) -> np.ndarray:
    """exp of a rotation vector by its axis."""
    angle = np.linalg.norm(turn)
    k = np.cross(np.eye(3), turn / angle)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def _log(rotation: np.ndarray) -> np.ndarray:
    """θ / (2 sin θ) of what is not symmetric."""
    angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
    r = rotation - rotation.T
    return angle / (2 * np.sin(angle)) * np.array([r[2, 1], r[0, 2], r[1, 0]])


def test_rotations_by_nothing_and_by_half_a_turn(row: Row) -> None:
    """exp and log of motions: 0 / 0 at no rotation, no axis at half a turn."""
    generator = np.random.default_rng(0)
    worst = 0.0
    for angle in (0.0, 1e-12, 1e-8, 1e-4, 1.0, math.pi - 1e-7, math.pi):
        axis = generator.normal(size=3)
        motion = np.concatenate([angle * axis / np.linalg.norm(axis), generator.normal(size=3)])
        matrix = motion_to_matrix(motion[None])[0]
        assert np.isfinite(matrix).all() and np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() < 1e-12
        again = motion_to_matrix(matrix_to_motion(matrix[None]))[0]
        worst = max(worst, float(np.abs(again - matrix).max()))
    assert worst < 1e-6
    with np.errstate(invalid="ignore"):
        assert np.isnan(_rodrigues(np.zeros(3))).all() and np.isnan(_log(np.eye(3))).all()
    some = motion_to_matrix(np.array([[0.3, -0.4, 0.1, 0.0, 0.0, 0.0]]))[0, :3, :3]
    np.testing.assert_allclose(_rodrigues(_log(some)), some, atol=1e-12)
    axes = generator.normal(size=(100, 3))
    turns = np.concatenate([math.pi * axes / np.linalg.norm(axes, axis=1, keepdims=True), np.zeros((100, 3))], 1)
    half = motion_to_matrix(turns)
    with np.errstate(divide="ignore", invalid="ignore"):
        lost = sum(not np.abs(_rodrigues(_log(m[:3, :3])) - m[:3, :3]).max() < 0.1 for m in half)
    assert lost > 30 and np.abs(motion_to_matrix(matrix_to_motion(half)) - half).max() < 1e-6
    row(
        "rotations by 0 and by π",
        f"exp by ω / norm(ω): NaN at 0; log by θ / (2 sin θ) (R - Rᵀ): NaN at 0, another axis or NaN for {lost} of 100 at π",
        f"exp and log agree to {worst:.0e}",
    )


# --- the same again


def _atomic_sums(orders: int) -> float:
    """Gradients of 20,000 samples added to 64 rows of a table in the order in which threads come: share of sums not equal in all."""
    generator = torch.Generator().manual_seed(0)
    row, gradient = torch.randint(64, (20_000,), generator=generator), torch.randn(20_000, generator=generator)
    sums = []
    for _ in range(orders):
        order = torch.randperm(20_000, generator=generator)
        sums.append(torch.zeros(64).index_add(0, row[order], gradient[order]))
    return float((torch.stack(sums) != sums[0]).any(0).float().mean())


@pytest.mark.usefixtures("decided_by_few_rays")
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
    usual = _atomic_sums(8)
    assert usual > 0.5
    row(
        f"the same fit again, torch on {threads} thread{'s' * (threads > 1)}",
        f"gradients added in the order of the threads: {usual:.0%} of the sums differ from time to time",
        "equal to the last bit",
    )


def test_matter_before_a_camera_that_no_picture_shows(row: Row, tmp_path: Path) -> None:
    """The sphere around everything that a fit starts from: rays of the fit begin on this side of it, those of a view from afar beyond."""
    recipe = QUICK.with_changes({
        "surface.background": "on", "surface.initial_radius": 0.4, "surface.outer_radius": 1.4, "schedule.sharpness_start": 200.0,
        "sampling.occupancy_resolution": 96,
    })  # fmt: skip
    poses = around(3)
    field = _fit(tmp_path, {"rgb": poses}, steps=1, recipe=recipe)
    far = poses[0] @ np.diag([1.0, -1.0, -1.0, 1.0])
    far[:3, 3] *= 1.8
    away = np.linalg.norm((far[:3, 3] - field.region.centre) / field.region.radius)
    middle = Camera(1, 1, 40.0, 40.0, 0.0, 0.0)
    ours = float(field.render(middle, far).depth_ray[0, 0]) / field.region.radius
    field.occupancy.update(field.surface.at(3), 200.0)  # by the distance alone
    usual = float(field.render(middle, far).depth_ray[0, 0]) / field.region.radius
    row(
        f"matter before a camera that no picture shows, {away:.1f} radii from the centre",
        f"by the distance alone: met after {usual:.2f} radii",
        f"the ball behind it, after {ours:.2f}; exact {away - 0.4:.2f}",
    )
    assert usual == pytest.approx(FREE * (away - 1.0), abs=0.01)
    assert ours == pytest.approx(away - 0.4, abs=0.05)


def test_matter_that_no_picture_reaches(row: Row, tmp_path: Path) -> None:
    """The lower half of the sphere that a fit starts from, seen from above alone: a view from the side would see it all the same."""
    recipe = QUICK.with_changes({"schedule.sharpness_start": 200.0, "sampling.occupancy_resolution": 96})
    above = [look_from((0.5 * math.cos(i), 0.5 * math.sin(i), 2.6)) for i in range(5)]
    field = _fit(tmp_path, {"rgb": above}, steps=1, recipe=recipe)
    side, middle = look_from((2.6, 0.0, 0.0)) @ np.diag([1.0, -1.0, -1.0, 1.0]), Camera(1, 1, 40.0, 40.0, 0.0, 0.0)
    side[:3, 3] = field.region.centre + field.region.radius * np.array([2.6, 0.0, 0.0])
    lenses = [above[0] @ np.diag([1.0, -1.0, -1.0, 1.0]), above[3] @ np.diag([1.0, -1.0, -1.0, 1.0])]
    wide = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)

    def looks() -> tuple[list[float], np.ndarray]:
        heights = []
        for z in (0.35, -0.35):
            pose = side.copy()
            pose[2, 3] += field.region.radius * z
            heights.append(float(field.render(middle, pose).opacity[0, 0]))
        return heights, np.stack([field.render(wide, pose).channels["rgb"] for pose in lenses])

    (top, bottom), seen = looks()
    field.occupancy.update(field.surface.at(3), 200.0)  # by the distance alone
    (usual_top, usual_bottom), usual = looks()
    row(
        "a ball seen from above alone, its lower half from the side",
        f"by the distance alone: opacity {usual_bottom:.2f}",
        f"{bottom:.2f}; the upper half {top:.2f}",
    )
    assert usual_top > 0.99 and usual_bottom > 0.99
    assert top > 0.99 and bottom == 0.0
    assert np.abs(seen - usual).max() < 0.02  # at the limb, along which light is met over a fifth of a radius
