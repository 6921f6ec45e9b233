"""Hard cases of light, fitted: a ball that mirrors the room, black gloss, wires thinner than a pixel, a hole of one pixel, glass."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import scipy.stats

from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import fit
from mmsynth.scene.load import load_scene
from mmsynth.sensors.metrics import psnr_from_mse

Row = Callable[[str, str, str], None]
Light = Callable[[np.ndarray, np.ndarray], np.ndarray]  # origin (3,), directions (..., 3) → colours (..., 3)

SIZE, FOCAL, VIEWS, FINER = 36, 48.0, 30, 4
DISTANCE, RADIUS = 2.6, 0.7
FOOTPRINT = DISTANCE / FOCAL  # of a pixel at the origin
SMALL = {
    "sampling.samples_per_step": 4096, "sampling.samples_growth": 1.0,
    "sampling.initial_rays": 256, "surface.max_rows_log2": 12, "radiance.max_rows_log2": 13,
    "sampling.occupancy_resolution": 24, "loss.eikonal_points": 128, "radiance.hidden_width": 32, "schedule.view_dependence_from": 0.2,
    "poses.views": "off", "poses.rig": "off",
}  # fmt: skip
PAINTED = {"radiance.view_dependence": 0, "radiance.light": "off"}  # light that does not move with the viewer
LAMPS = np.array([[0.5, 0.2, 0.84], [-0.7, 0.5, 0.5]])


def room(d: np.ndarray) -> np.ndarray:
    return 0.35 + 0.2 * np.sin(5 * d)


def ball(o: np.ndarray, d: np.ndarray, radius: float = RADIUS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance (inf where it is missed), normals and mirrored directions."""
    b = d @ o
    inside = b**2 - (o @ o - radius**2)
    t = np.where(inside > 0, -b - np.sqrt(np.maximum(inside, 0)), np.inf)
    n = (o + d * np.where(np.isfinite(t), t, 0)[..., None]) / radius
    return t, n, d - 2 * (d * n).sum(-1, keepdims=True) * n


def pose_of(i: int) -> np.ndarray:
    """OpenGL camera_to_world that looks at the origin."""
    angle, height = 2 * np.pi * i / VIEWS, 0.3 + 0.7 * (i % 3)
    eye = np.array([np.cos(angle), np.sin(angle), height])
    eye *= DISTANCE / np.linalg.norm(eye)
    back = eye / DISTANCE
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], 1)
    return pose


def rays(pose: np.ndarray, finer: int) -> np.ndarray:
    """(S, S, 3) unit directions of finer² rays a pixel."""
    at = (np.arange(SIZE * finer) + 0.5) / finer - SIZE / 2
    u, v = np.meshgrid(at, at)
    d = np.stack([u / FOCAL, -v / FOCAL, -np.ones_like(u)], -1) @ pose[:3, :3].T
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def picture(light: Light, i: int) -> np.ndarray:
    """Means over the pixels, (S, S, 3)."""
    pose = pose_of(i)
    return light(pose[:3, 3], rays(pose, FINER)).reshape(SIZE, FINER, SIZE, FINER, 3).mean((1, 3))


@dataclass(frozen=True)
class Seen:
    """Test views, stacked: what the field shows and the truth (N, S, S, 3), the field's and the ball's distance (N, S, S)."""

    shown: np.ndarray
    truth: np.ndarray
    depth: np.ndarray
    ball: np.ndarray

    def psnr(self, where: np.ndarray) -> float:
        return psnr_from_mse(float(np.square(self.shown - self.truth)[where].mean()))

    @property
    def inside(self) -> np.ndarray:
        """Pixels well within the ball's silhouette."""
        eroded = cv2.erode(np.moveaxis(np.isfinite(self.ball), 0, -1).astype(np.uint8), np.ones((3, 3)))
        return np.moveaxis(eroded, -1, 0).astype(bool)

    @property
    def off(self) -> float:
        """Median error of the ball's distance, in its radii."""
        return float(np.median(np.abs(self.depth - self.ball)[self.inside])) / RADIUS


def fitted(light: Light, folder: Path, steps: int = 400, seed: int = 0, **recipe: object) -> Seen:
    folder.mkdir(parents=True)
    frames = []
    for i in range(VIEWS):
        cv2.imwrite(str(folder / f"{i:03}.png"), np.rint(np.clip(picture(light, i), 0, 1)[..., ::-1] * 65535).astype(np.uint16))
        frames.append({"file_path": f"{i:03}.png", "transform_matrix": pose_of(i).tolist()})
    intrinsics = {"w": SIZE, "h": SIZE, "fl_x": FOCAL, "fl_y": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, "frames": frames}))
    scene = load_scene(folder)
    field = fit(scene, folder / "run", recipe=Recipe().with_changes({**SMALL, **recipe}), steps=steps, seed=seed)
    views = [frame for frame in scene.frames if frame.view in scene.split.test]
    shown = [field.render(frame.camera, frame.camera_to_world) for frame in views]
    assert all(np.isfinite(x.channels["rgb"]).all() for x in shown)
    truth = [picture(light, frame.view) for frame in views]
    balls = [ball(pose_of(frame.view)[:3, 3], rays(pose_of(frame.view), 1))[0] for frame in views]
    return Seen(np.stack([x.channels["rgb"] for x in shown]), np.stack(truth), np.stack([x.depth_ray for x in shown]), np.stack(balls))


def mirror_ball(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    t, _, mirrored = ball(o, d)
    return np.where(np.isfinite(t)[..., None], np.array([0.9, 0.85, 0.7]) * room(mirrored), room(d))


def black_gloss(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Nothing but two lamps' images on black, before a painted room."""
    t, _, mirrored = ball(o, d)
    lobes = sum(np.exp(40.0 * np.minimum(mirrored @ lamp / np.linalg.norm(lamp) - 1.0, 0.0)) for lamp in LAMPS)
    return np.where(np.isfinite(t)[..., None], 0.8 * lobes[..., None] * np.array([1.0, 0.9, 0.8]), room(d))


def wires(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Three white wires, half a pixel thick, through the origin, before a painted room."""
    seen = room(d)
    for axis in np.eye(3):
        across = np.cross(d, axis)
        miss = np.abs(across @ o) / np.maximum(np.linalg.norm(across, axis=-1), 1e-9)
        # where along the wire the ray passes it
        along = np.cross(across, d) @ o / np.maximum((across * across).sum(-1), 1e-9)
        seen = np.where(((miss < 0.25 * FOOTPRINT) & (np.abs(along) < 0.7))[..., None], 1.0, seen)
    return seen


def slab_with_a_hole(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """A dark disc with a hole of a pixel, before a bright room."""
    t = -o[2] / np.where(np.abs(d[..., 2]) > 1e-6, d[..., 2], 1e-6)
    at = np.linalg.norm(o[:2] + t[..., None] * d[..., :2], axis=-1)
    return np.where(((t > 0) & (at < 0.7) & (at > 0.5 * FOOTPRINT))[..., None], 0.1, 0.8 + 0.1 * np.sin(3 * d))


def glass(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """A ball that lets seven tenths of the light through, straight, and mirrors a twentieth, before a painted room."""
    t, _, mirrored = ball(o, d)
    return np.where(np.isfinite(t)[..., None], np.array([0.5, 0.7, 0.6]) * room(d) + 0.05 * room(mirrored), room(d))


def test_a_mirror_ball(tmp_path: Path, row: Row) -> None:
    """A mirror of a room is a room behind the surface, for who sees colours only: it stays so, but no worse than it was.

    Of three seeds, each of which makes 0.02 radii: the means of both are 0.41, and which is less is chance (one CPU: by 1e-6). Asked is
    whether what seeds make explains that ours is farther off (Student's t)."""
    found = {}
    for name, recipe in (("painted", PAINTED), ("ours", {})):
        seen = [fitted(mirror_ball, tmp_path / f"{name}_{seed}", seed=seed, **recipe) for seed in range(3)]
        found[name] = np.array([(x.off, x.psnr(x.inside)) for x in seen])
    farther = scipy.stats.ttest_ind(found["ours"][:, 0], found["painted"][:, 0], alternative="greater")
    (usual_off, usual_psnr), (off, psnr) = found["painted"].mean(0), found["ours"].mean(0)
    assert farther.pvalue > 0.01 and psnr > usual_psnr - 0.5
    row(
        "a ball that mirrors the room",
        f"painted: {usual_off:.2f} radii off, {usual_psnr:.1f} dB",
        f"{off:.2f} radii off, {psnr:.1f} dB: not solved",
    )


def test_a_black_glossy_ball(tmp_path: Path, row: Row) -> None:
    """Nothing but highlights on it: they are found to be the images of lamps. Whether these pay is not asked: so short
    a trial is decided by chance (off with one seed in five)."""
    usual, ours = (fitted(black_gloss, tmp_path / light, **{"radiance.light": light}) for light in ("off", "on"))
    assert ours.off < 0.05 and ours.psnr(ours.inside) > usual.psnr(ours.inside) + 2.0
    row(
        "a black ball with two highlights", f"harmonics of the direction: {usual.psnr(ours.inside):.1f} dB",
        f"{ours.psnr(ours.inside):.1f} dB, {ours.off:.2f} radii off",
    )  # fmt: skip


def test_wires_of_half_a_pixel(tmp_path: Path, row: Row) -> None:
    ours = fitted(wires, tmp_path / "wires")
    without = np.stack([picture(lambda _, d: room(d), i) for i in (9, 19, 29)])
    there = np.abs(ours.truth - without).max(-1) > 0.1
    usual, found = psnr_from_mse(float(np.square(without - ours.truth)[there].mean())), ours.psnr(there)
    assert there.sum() > 50 and found > usual + 3.0
    row("wires of half a pixel", f"not seen: {usual:.1f} dB in their pixels", f"{found:.1f} dB")


def test_a_hole_of_one_pixel(tmp_path: Path, row: Row) -> None:
    """How much of the light in it is seen from before and above."""
    ours = fitted(slab_with_a_hole, tmp_path / "hole")
    middle = slice(SIZE // 2 - 1, SIZE // 2 + 1)
    lit, true = (float(x[1:, middle, middle].mean()) - 0.1 for x in (ours.shown, ours.truth))
    assert true > 0.05 and 0.0 < lit < 1.1 * true
    row("a hole of one pixel", "closed: 0% of its light", f"{lit / true:.0%} of its light")


def test_glass(tmp_path: Path, row: Row) -> None:
    """What is seen through it is painted on it and moves with the viewer; its silhouette stays."""
    painted, ours = fitted(glass, tmp_path / "painted", **PAINTED), fitted(glass, tmp_path / "ours")
    assert ours.off < 0.05 and ours.psnr(ours.inside) > painted.psnr(ours.inside) + 6.0
    row(
        "a ball of glass", f"painted: {painted.off:.2f} radii off, {painted.psnr(ours.inside):.1f} dB",
        f"{ours.off:.2f} radii off, {ours.psnr(ours.inside):.1f} dB",
    )  # fmt: skip
