"""A field known in closed form: the double that stands in for a learned one in the tests of the operations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from conftest import look_at

from mmsynth.field.design import Corrections
from mmsynth.field.field import Field
from mmsynth.field.kernels import Sampling
from mmsynth.field.picture import Rendering
from mmsynth.scene.image_writers import write_npz, write_png16
from mmsynth.scene.scene import Frame, Region, Scene, Sensor, Split
from mmsynth.sensors.camera import Camera, ray_map
from mmsynth.sensors.mosaic import mosaic
from mmsynth.sensors.polarization import stokes_to_intensities

RGB = Sensor("rgb", ("R", "G", "B"), (None, None, None), np.array([[1, 2], [0, 1]]))
MONO = Sensor("mono", ("mono",), (None,))
POL = Sensor("pol", ("0", "45", "90", "135"), (None,) * 4, np.array([[2, 1], [3, 0]]), (0.0, 45.0, 90.0, 135.0))
MS = Sensor(
    "ms",
    ("692", "653", "611", "572", "541", "503", "464", "431", "pan"),
    (692.0, 653.0, 611.0, 572.0, 541.0, 503.0, 464.0, 431.0, None),
    np.array([[4, 5, 6], [2, 1, 0], [3, 8, 7]]),
)

Distance = Callable[[np.ndarray], np.ndarray]


def _length(v: np.ndarray) -> np.ndarray:
    """Of vectors (..., 3): numpy's norm takes four times as long."""
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", v, v)))


def sphere(radius: float = 0.6, centre: Sequence[float] = (0.0, 0.0, 0.0)) -> Distance:
    return lambda p: _length(p - np.asarray(centre)) - radius


def torus(major: float = 0.5, minor: float = 0.2) -> Distance:
    return lambda p: np.hypot(np.hypot(p[..., 0], p[..., 1]) - major, p[..., 2]) - minor


def meets_ball(points: np.ndarray, eye: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Whether the straight way from each point (..., 3) to the eye leads through a ball."""
    way = eye - points
    nearest = np.clip(np.sum((centre - points) * way, -1) / np.sum(way * way, -1), 0.0, 1.0)
    return np.linalg.norm(points + nearest[..., None] * way - centre, axis=-1) < radius


class AnalyticField:
    """Lambertian-like surface under a fixed light; polarization axis along the projected normal, DoLP 0.3."""

    def __init__(
        self,
        distance: Distance,
        sensors: Sequence[Sensor] = (RGB, MS, POL, MONO),
        region: Region | None = None,
        mirrored: float = 0.0,
    ) -> None:
        self.distance, self.mirrored = distance, mirrored
        self.region = region or Region((0.0, 0.0, 0.0), 1.0)
        self.unit = "m"
        self.manifest: dict[str, Any] = {}
        self.sensors = {s.name: s for s in sensors}
        camera = Camera(24, 18, 26.0, 26.0, 11.3, 8.6, (-0.1, 0.05, 0.001, -0.002))
        self.predicted: list[str] = []
        self.corrections = Corrections({}, {})
        self.measured = list(self.sensors)
        self.cameras = {s.name: camera for s in sensors}
        self.rig = {s.name: np.eye(4) for s in sensors}
        for i, s in enumerate(sensors):
            self.rig[s.name][0, 3] = 0.05 * i
        self.sampling = Sampling(math.inf, 0.0, 1, 1)
        self.points, self.tile = 0, 8192  # that were asked for; rays at a time
        self.renders = 0

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"value": torch.from_numpy(self.sdf(np.eye(3)))}

    def sdf(self, points: np.ndarray) -> np.ndarray:
        self.points += len(points)
        return self.distance(np.asarray(points, float)).astype(np.float32)

    check_modalities = Field.check_modalities

    def pose_of(self, frame: Frame) -> np.ndarray:
        return frame.camera_to_world

    def normal(self, p: np.ndarray) -> np.ndarray:
        step = 1e-4 * np.eye(3)
        slope = np.stack([self.distance(p + e) - self.distance(p - e) for e in step], -1)
        return slope / np.maximum(_length(slope)[..., None], 1e-12)

    @property
    def shines(self) -> bool:
        return self.mirrored > 0

    def cast(
        self, directions: np.ndarray, camera_to_world: np.ndarray, modalities: Sequence[str], geometry: bool, light: bool = False
    ) -> dict[str, np.ndarray]:
        """Rays of one camera, as ``Field.cast``; with ``light``, a white lamp's image is ``mirrored`` of the shade."""
        direction, origin = directions @ camera_to_world[:3, :3].T, camera_to_world[:3, 3]
        t, going = np.zeros(len(directions)), np.arange(len(directions))
        for _ in range(100):
            step = np.clip(self.distance(origin + direction[going] * t[going, None]), -1, 1)
            t[going] += step
            going = going[(np.abs(step) > 1e-12) & (t[going] < 50)]
            if not len(going):
                break
        point = origin + direction * t[:, None]
        hit = (np.abs(self.distance(point)) < 1e-4) & (t > 0)
        normal = self.normal(point)
        sun = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
        shade = np.where(hit, 0.15 + 0.6 * np.clip(normal @ sun, 0, None), 0.05)
        out = {"opacity": hit, "depth": np.where(hit, t / self.region.radius, np.nan), "normal": np.where(hit[:, None], normal, np.nan)}
        for name in modalities:
            sensor = self.sensors[name]
            out[name] = shade[:, None] * np.linspace(1.0, 0.5, sensor.channel_count)
            if sensor.polarizer_angles_deg is not None:
                phi = np.arctan2(-(normal @ camera_to_world[:3, 1]), normal @ camera_to_world[:3, 0])
                dolp = np.where(hit, 0.3, 0.0)
                s = np.stack([shade, shade * dolp * np.cos(2 * phi), shade * dolp * np.sin(2 * phi)], -1)
                out[f"stokes/{name}"] = s
                out[name] = stokes_to_intensities(torch.from_numpy(s), sensor.polarizer_angles_deg).numpy()
                if light:
                    out[f"mirrored_s0/{name}"] = self.mirrored * shade
            if light:
                out[f"mirrored/{name}"] = np.repeat(self.mirrored * shade[:, None], sensor.channel_count, 1)
        if light:
            out |= {"roughness": np.where(hit, 0.25, np.nan), "strength": np.where(hit, 2.0, np.nan)}
        return {key: value.astype(np.float32) for key, value in out.items()}

    cast_tiles = Field.cast_tiles

    device = torch.device("cpu")

    def to_normalised(self, points: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(((np.asarray(points) - np.array(self.region.centre)) / self.region.radius).astype(np.float32))

    def render_rays(
        self, origins: torch.Tensor, directions: torch.Tensor, camera_x: torch.Tensor, modalities: Sequence[str], geometry: bool
    ) -> dict[str, torch.Tensor]:
        """Of the normalised frame, as ``Field.render_rays``; depth alone."""
        centre = np.array(self.region.centre)
        poses = [
            look_at(o.numpy() * self.region.radius + centre, (o + d).numpy() * self.region.radius + centre)
            for o, d in zip(origins, directions, strict=True)
        ]
        depth = [self.cast(np.array([[0.0, 0.0, 1.0]]), pose, [], False)["depth"] for pose in poses]
        return {"depth": torch.from_numpy(np.concatenate(depth))}

    def render(
        self,
        camera: Camera,
        camera_to_world: np.ndarray,
        modalities: Sequence[str] | None = None,
        geometry: bool = True,
        progress: Callable[[int], None] | None = None,
    ) -> Rendering:
        names = self.check_modalities(modalities)
        self.renders += 1
        in_camera, valid = ray_map(camera)
        cast = self.cast(in_camera.reshape(-1, 3), camera_to_world, names, geometry)
        image = {key: np.where(valid[..., None], value.reshape(*valid.shape, -1), np.nan) for key, value in cast.items()}
        if progress is not None:
            progress(int(valid.sum()))
        depth = image["depth"][..., 0] * np.float32(self.region.radius)
        return Rendering(
            {name: image[name] for name in names},
            {name: image[f"stokes/{name}"] for name in names if f"stokes/{name}" in image},
            (depth * in_camera[..., 2]).astype(np.float32),
            depth,
            image["normal"],
            np.nan_to_num(image["opacity"][..., 0]),
            valid.copy(),
            {},
        )


SOURCE_NAMES = {"pol": "polarization", "ms": "multispectral"}


def stripes(points_u: np.ndarray, points_v: np.ndarray) -> np.ndarray:
    return 1.0 + 0.2 * np.sin(points_u / 3.0) * np.cos(points_v / 4.0)


class WrongField(AnalyticField):
    """Its light is off by a pattern, the same in all modalities, as where a shadow or an edge is out of place."""

    wrong = True

    def render(self, camera: Camera, *args: Any, **how: Any) -> Any:
        seen = super().render(camera, *args, **how)
        if self.wrong:
            v, u = np.mgrid[: camera.height, : camera.width]
            for group in (seen.channels, seen.stokes):
                for values in group.values():
                    values /= stripes(u, v)[..., None].astype(np.float32)
        return seen


def ring_pose(view: int, views: int) -> np.ndarray:
    angle = 2 * np.pi * view / views
    return look_at((2.2 * np.cos(angle), 2.2 * np.sin(angle), 1.0))


def scene_of(field: AnalyticField, root: Path, views: int = 4, truth: bool = True) -> Scene:
    """What the rig of the field would have recorded, on disk, with ground truth; the last view tests."""
    frames = []
    for name, sensor in field.sensors.items():
        source = SOURCE_NAMES.get(name, name)
        for view in range(views):
            camera, pose = field.cameras[name], ring_pose(view, views) @ field.rig[name]
            seen = field.render(camera, pose, [name])
            light = np.nan_to_num(seen.channels[name])
            path = root / "modalities" / source / f"{view:04d}.png"
            raw = light if sensor.mosaic is None else mosaic(torch.from_numpy(light).movedim(-1, 0), sensor.mosaic).numpy()
            write_png16(path, light[..., 0] if sensor.channel_count == 1 else raw)
            frames.append(Frame(name, view, path, camera, pose, source))
            if truth and view == views - 1:
                write_npz(root / "gt" / source / f"{view:04d}.npz", {"data": seen.stokes.get(name, light)})
                write_npz(root / "gt" / "masks" / f"{view:04d}_{source}.npz", {"in_roi": seen.opacity > 0.5})
    if truth:
        pose = ring_pose(views - 1, views)
        seen = field.render(field.cameras["rgb"], pose)
        aligned = {SOURCE_NAMES.get(n, n): seen.stokes.get(n, seen.channels[n]) for n in field.sensors if n != "rgb"}
        write_npz(root / "gt" / "aligned" / f"{views - 1:04d}.npz", aligned)
        geometry = {"depth_z": np.nan_to_num(seen.depth_z), "normal": np.nan_to_num(seen.normal), "in_roi": seen.opacity > 0.5}
        write_npz(root / "gt" / "geometry" / f"{views - 1:04d}.npz", geometry)
    split = Split(tuple(range(views - 1)), (views - 1,), "test")
    return Scene(root, "test", dict(field.sensors), tuple(frames), field.region, split, "m")
