"""A field that is known without a fit: a ball with fine random paint, and frames of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from analytic import RGB, ring_pose

from mmsynth.field.design import Design
from mmsynth.field.field import Field
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.scene import Frame, Region, Scene, Sensor, Split
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.mosaic import mosaic

CAMERA = Camera(160, 120, 170.0, 170.0, 79.2, 59.8, (-0.08, 0.02, 0.001, -0.001))


def painted_ball(*sensors: Sensor) -> Field:
    """What a field of hash grids is before it has learned anything, with more in its tables; sensors a little apart on the rig."""
    torch.manual_seed(0)
    design = Design(surface_levels=2, radiance_levels=4, surface_finest=8, radiance_finest=48, coarsest=6, occupancy=16, initial_radius=0.7)
    names = [sensor.name for sensor in sensors]
    rig = {name: np.eye(4) for name in names}
    for place, name in enumerate(names):
        rig[name][0, 3] = 0.05 * place
    of = dict(zip(names, sensors, strict=True))
    made = Field(design, of, dict.fromkeys(names, 0.4), Region((0.0, 0.0, 0.0), 1.0), cameras=dict.fromkeys(names, CAMERA), rig=rig)
    with torch.no_grad():
        made.appearance.table.normal_(std=1.0)
        for p in made.shader.parameters():
            p.mul_(2.0)
    made.sampling = type(made.sampling)(400.0, 0.005, 2, 4)
    return made


def raw_of(field: Field, pose: np.ndarray, seed: int, sensor: Sensor = RGB) -> np.ndarray:
    """What a sensor records from a pose: (H, W) of a mosaic, else (H, W, C), with noise."""
    image = np.nan_to_num(field.render(CAMERA, pose, geometry=False).channels[sensor.name])
    raw = image if sensor.mosaic is None else mosaic(torch.from_numpy(image).movedim(-1, 0), sensor.mosaic).numpy()
    return np.clip(raw + 0.004 * np.random.default_rng(seed).normal(size=raw.shape), 0, 1).astype(np.float32)


def scene_of_ball(field: Field, folder: Path, train: int, test: int) -> Scene:
    """Views on a ring, all sensors in each; the last ones are test views."""
    frames, views = [], train + test
    for name, sensor in field.sensors.items():
        for view in range(views):
            path, pose = folder / name / f"{view:04d}.png", ring_pose(view, views) @ field.rig[name]
            write_png16(path, raw_of(field, pose, view, sensor))
            frames.append(Frame(name, view, path, CAMERA, pose))
    split = Split(tuple(range(train)), tuple(range(train, views)), "test")
    return Scene(folder, "test", dict(field.sensors), tuple(frames), field.region, split, "m")
