"""A painted ball in the dark, seen by cameras anywhere, as files that the readers know."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mmsynth.fitting.recipe import Recipe

WIDTH, HEIGHT, FOCAL, RADIUS = 32, 24, 40.0, 0.7
QUICK = Recipe().with_changes({
    "sampling.samples_per_step": 1024, "sampling.samples_growth": 1.0,
    "sampling.initial_rays": 128, "surface.levels": 3, "surface.max_rows_log2": 12,
    "radiance.levels": 3, "radiance.max_rows_log2": 12, "sampling.occupancy_resolution": 16, "sampling.occupancy_every": 8,
    "loss.eikonal_points": 64, "radiance.hidden_width": 16,
})  # fmt: skip


def look_from(eye: Sequence[float], up: Sequence[float] = (0.0, 0.0, 1.0)) -> np.ndarray:
    """(4, 4) OpenGL camera_to_world of a camera that looks at the origin."""
    position = np.array(eye, float)
    back = position / np.linalg.norm(position)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], 1)
    return pose


def around(count: int, distance: float = 2.6) -> list[np.ndarray]:
    """Poses on all sides, at three heights."""
    angles = 2 * np.pi * np.arange(count) / count
    return [look_from((distance * np.cos(a), distance * np.sin(a), 0.5 + 0.6 * (i % 3))) for i, a in enumerate(angles)]


def picture(pose: np.ndarray, scale: float = 1.0, width: int = WIDTH, height: int = HEIGHT, fisheye: bool = False) -> np.ndarray:
    """(H, W, 3) linear: the ball, ``scale`` times as large, on black. A fisheye's r = f θ holds from side to side."""
    v, u = np.mgrid[:height, :width]
    x, y = (u - (width - 1) / 2) / FOCAL, -(v - (height - 1) / 2) / FOCAL
    if fisheye:
        angle = np.hypot(x, y)
        across = np.sinc(angle / np.pi)
        local = np.stack([x * across, y * across, -np.cos(angle)], -1)
    else:
        local = np.stack([x, y, -np.ones_like(x)], -1)
    d = local @ pose[:3, :3].T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    o = pose[:3, 3] / scale
    b = d @ o
    inside = b**2 - (o @ o - RADIUS**2)
    hit = (inside > 0) & (b < 0)
    n = (o + d * (-b - np.sqrt(np.maximum(inside, 0)))[..., None]) / RADIUS
    paint = 0.4 + 0.25 * np.sin(4 * n + np.array([0.0, 1.0, 2.0]))
    return np.where(hit[..., None], paint, 0.0)


def write_scene(
    folder: Path,
    poses: dict[str, list[np.ndarray]],
    scale: float = 1.0,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    alter: dict[str, Any] | None = None,
    file_type: str = "png",
    fisheye: bool = False,
) -> Path:
    """A transforms.json of modalities ``rgb`` (three channels) or any other (one); ``alter[modality]`` changes its pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for name, places in poses.items():
        for i, pose in enumerate(places):
            image = picture(pose, scale, *size, fisheye)
            image = image if name == "rgb" else image.mean(-1)
            image = (alter or {}).get(name, lambda x: x)(image).astype(np.float32)
            path = folder / f"{name}_{i:03}.{file_type}"
            if file_type == "npy":
                np.save(path, image)
            else:
                stored = np.rint(np.clip(image, 0, 1) * 65535).astype(np.uint16)
                cv2.imwrite(str(path), stored if stored.ndim == 2 else stored[..., [2, 1, 0, *range(3, stored.shape[2])]])
            frames.append({"file_path": path.name, "modality": name, "view": i, "transform_matrix": pose.tolist()})
    intrinsics = {"w": size[0], "h": size[1], "fl_x": FOCAL, "fl_y": FOCAL, "cx": size[0] / 2, "cy": size[1] / 2}
    lens = {"camera_model": "OPENCV_FISHEYE"} if fisheye else {}
    (folder / "transforms.json").write_text(json.dumps({**intrinsics, **lens, "frames": frames}))
    return folder
