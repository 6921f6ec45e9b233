"""Hard cases of choosing how to convert: a light that moves with the camera, and a frame whose residual is its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from analytic import MONO, MS, RGB, AnalyticField, scene_of, sphere, stripes

from mmsynth.operations.conversion.moving_light import moving_light
from mmsynth.operations.evaluation.conversions import evaluate_conversion
from mmsynth.sensors.camera import Camera

Row = Callable[[str, str, str], None]

VIEWS = 12
CAMERA = Camera(48, 36, 52.0, 52.0, 23.1, 17.6, (-0.1, 0.05, 0.001, -0.002))
ALL = ("field", "ratio", "guided", "linear", "nearest")


def built(kind: Any) -> Any:
    field = kind(sphere(), (RGB, MS, MONO))
    field.cameras = dict.fromkeys(field.cameras, CAMERA)
    return field


class Flash(AnalyticField):
    """Mono is lit by a flash at its camera: paint, times cos θ / d²."""

    def cast(self, directions: np.ndarray, camera_to_world: np.ndarray, *args: Any, **how: Any) -> Any:
        seen = super().cast(directions, camera_to_world, *args, **how)
        if "mono" in seen:
            distance = np.nan_to_num(seen["depth"][:, 0], nan=10.0) if seen["depth"].ndim > 1 else np.nan_to_num(seen["depth"], nan=10.0)
            points = directions @ camera_to_world[:3, :3].T * distance[:, None] + camera_to_world[:3, 3]
            paint = 1.0 + 0.3 * np.sin(9.0 * points[:, 2]) * np.cos(7.0 * points[:, 0])
            cosine = np.abs(np.sum(np.nan_to_num(seen["normal"]) * (directions @ camera_to_world[:3, :3].T), -1))
            seen["mono"] = (paint * self.lit(cosine, distance)).astype(np.float32)[:, None]
        return seen

    def lit(self, cosine: np.ndarray, distance: np.ndarray) -> np.ndarray:
        return 0.05 + 1.5 * cosine / distance**2


class Unlit(Flash):
    """A field that took it for paint of one brightness."""

    def lit(self, cosine: np.ndarray, distance: np.ndarray) -> np.ndarray:
        return np.where(cosine > 0, 0.4, 0.07)


class OwnPattern(AnalyticField):
    """A field that misses what only rgb shows: a pattern that the other modalities do not have."""

    def render(self, camera: Camera, *args: Any, **how: Any) -> Any:
        seen = super().render(camera, *args, **how)
        if "rgb" in seen.channels:
            v, u = np.mgrid[: camera.height, : camera.width]
            seen.channels["rgb"] /= (stripes(u, v)[..., None] ** 1.5).astype(np.float32)
        return seen


def test_a_light_that_moves_with_the_camera(tmp_path: Path, row: Row) -> None:
    """It is seen, in the one modality that has it; and auto takes what it can from the target's own frames."""
    scene, field = scene_of(built(Flash), tmp_path, views=VIEWS), built(Unlit)
    lights = {name: moving_light(field, scene, name) for name in field.sensors}
    assert lights["mono"].moves and not lights["rgb"].moves and not lights["ms"].moves
    found = evaluate_conversion(field, scene, "rgb", "mono")
    psnr = {name: found["methods"][name]["psnr"] for name in (*ALL, "auto")}
    assert found["evidence"]["light_moves"] == ["mono"]
    assert psnr["auto"] > max(psnr[name] for name in ALL) - 0.1 and psnr["auto"] > psnr["ratio"] + 1.0
    row(
        "a flash that moves with the camera, in one of two modalities",
        f"the gain of the other modality: {psnr['ratio']:.1f} dB",
        f"said (exponent of cos θ / d²: {lights['mono'].share:.2f} ± {lights['mono'].sd:.2f}); weighed by evidence: {psnr['auto']:.1f} dB",
    )


def test_a_residual_that_is_the_source_s_own(tmp_path: Path, row: Row) -> None:
    """What only the source shows must not be printed on the target: the field is best, and auto is the field."""
    scene, field = scene_of(built(AnalyticField), tmp_path, views=VIEWS), built(OwnPattern)
    found = evaluate_conversion(field, scene, "rgb", "ms")
    psnr = {name: found["methods"][name]["psnr"] for name in (*ALL, "auto")}
    assert psnr["ratio"] < psnr["field"] - 3.0
    assert psnr["auto"] > psnr["field"] - 0.1 and found["auto"]["field"] > 0.9
    row(
        "a pattern that only the source's frame shows",
        f"the gain carried over: {psnr['guided']:.1f} dB, the field alone {min(psnr['field'], 99.0):.0f} dB",
        f"left out by evidence: {min(psnr['auto'], 99.0):.0f} dB",
    )
