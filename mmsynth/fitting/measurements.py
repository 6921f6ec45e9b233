"""The pixels to learn from, in memory as they were stored, and random batches of them as rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, Region, Scene, Sensor
from mmsynth.sensors.camera import Camera, ray_map
from mmsynth.sensors.mosaic import channel_map
from mmsynth.sensors.polarization import analyser_axes


@dataclass(frozen=True)
class Batch:
    """Rays of one modality, R of them, in the normalised frame.

    Attributes:
        origins, directions: (R, 3). target: (R, K) raw values. channel: (R,) the measured channel of a mosaic (K = 1), else None.
        axes: (R, K, 3) analyser axes of a polarization sensor, else None. alpha: (R,) opacity to match, else None.
    """

    modality: str
    origins: Tensor
    directions: Tensor
    target: Tensor
    channel: Tensor | None
    axes: Tensor | None
    alpha: Tensor | None


class Measurements:
    """All training pixels of one modality.

    Integer images stay integers (8 or 16 bit), so a scene takes the memory of its files, decoded, and no more.
    """

    def __init__(self, sensor: Sensor, frames: tuple[Frame, ...], region: Region) -> None:
        self.sensor = sensor
        self.cameras: list[Camera] = list(dict.fromkeys(f.camera for f in frames))
        values, alphas = [], []
        for frame in frames:
            pixels, alpha = load_frame(sensor, frame)
            values.append(_compact(pixels.reshape(-1, 1 if pixels.ndim == 2 else pixels.shape[2])))
            alphas.append(None if alpha is None else _compact(alpha.reshape(-1)))
        self.values, self.alphas = values, alphas
        self.camera_index = np.array([self.cameras.index(f.camera) for f in frames])
        poses = np.stack([f.camera_to_world for f in frames])
        self.rotations = poses[:, :3, :3].astype(np.float32)
        self.origins = ((poses[:, :3, 3] - np.array(region.centre)) / region.radius).astype(np.float32)
        self.directions, self.usable = [], []
        for camera in self.cameras:
            rays, valid = ray_map(camera)
            self.directions.append(rays.reshape(-1, 3).astype(np.float32))
            self.usable.append(None if valid.all() else np.flatnonzero(valid))
            if not valid.any():
                raise InputError(f"{sensor.name}: the lens model has no valid ray for any pixel; check its distortion coefficients.")
        self.counts = np.array([_count(self.usable[c], self.directions[c]) for c in self.camera_index])
        self.ends = np.cumsum(self.counts)
        self.channels = [None if sensor.mosaic is None else channel_map(sensor.mosaic, c.height, c.width).reshape(-1) for c in self.cameras]
        self.has_alpha = any(a is not None for a in alphas)
        drawn, pixel = self.pick(min(int(self.ends[-1]), 1 << 18), np.random.default_rng(0))
        self.level = float(self.read(drawn, pixel)[0].mean())

    def pick(self, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """``count`` pixels, uniform over all frames with replacement, sorted by frame: frame and pixel indices, (count,) each."""
        drawn = np.sort(random.integers(0, self.ends[-1], count))
        frame = np.searchsorted(self.ends, drawn, side="right")
        pixel = drawn - (self.ends[frame] - self.counts[frame])
        for c, usable in enumerate(self.usable):
            if usable is not None:
                here = self.camera_index[frame] == c
                pixel[here] = usable[pixel[here]]
        return frame, pixel

    def rays(self, frame: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions, (N, 3) float32 each, normalised frame."""
        in_camera = np.empty((len(frame), 3), np.float32)
        for c, directions in enumerate(self.directions):
            here = self.camera_index[frame] == c
            in_camera[here] = directions[pixel[here]]
        return self.origins[frame], np.einsum("nij,nj->ni", self.rotations[frame], in_camera)

    def read(self, frame: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Values (N, K) and alpha (N,) or None, float32. With alpha, values are premultiplied: what the object adds to black."""
        starts = np.flatnonzero(np.r_[True, frame[1:] != frame[:-1]])
        runs = list(zip(starts, np.r_[starts[1:], len(frame)], strict=True))
        target = np.concatenate([_decode(self.values[frame[a]][pixel[a:b]]) for a, b in runs])
        if not self.has_alpha:
            return target, None
        alpha = [np.ones(b - a, np.float32) if (m := self.alphas[frame[a]]) is None else _decode(m[pixel[a:b]]) for a, b in runs]
        opacity = np.concatenate(alpha)
        return target * opacity[:, None], opacity

    def batch(self, count: int, random: np.random.Generator, device: torch.device) -> Batch:
        """A random batch of ``count`` rays."""
        frame, pixel = self.pick(count, random)
        origins, directions = self.rays(frame, pixel)
        target, alpha = self.read(frame, pixel)
        channel = None
        if self.sensor.mosaic is not None:
            measured = np.empty(count, np.int64)
            for c, channels in enumerate(self.channels):
                here = self.camera_index[frame] == c
                measured[here] = channels[pixel[here]]  # type: ignore[index]
            channel = torch.from_numpy(measured)
        axes = None
        world = torch.from_numpy(directions)
        if self.sensor.polarizer_angles_deg is not None:
            angles = torch.deg2rad(torch.tensor(self.sensor.polarizer_angles_deg, dtype=torch.float32))
            of_ray = angles[channel][:, None] if channel is not None else angles.expand(count, -1)
            camera_x = torch.from_numpy(np.ascontiguousarray(self.rotations[frame][:, :, 0]))
            axes = analyser_axes(world, camera_x, of_ray).to(device)
        return Batch(
            self.sensor.name,
            torch.from_numpy(origins).to(device),
            world.to(device),
            torch.from_numpy(target).to(device),
            None if channel is None else channel.to(device),
            axes,
            None if alpha is None else torch.from_numpy(alpha).to(device),
        )


def load_measurements(scene: Scene) -> dict[str, Measurements]:
    """Training pixels per modality.

    Raises:
        InputError: an image is missing, broken or of the wrong size; a modality has no light in any training frame.
    """
    out = {}
    for name, sensor in scene.sensors.items():
        frames = scene.frames_of(name, scene.split.train)
        if not frames:
            continue
        out[name] = Measurements(sensor, frames, scene.region)
        if not out[name].level > 0:
            raise InputError(f"{frames[0].path.parent}: all training frames of {name} are black, expected some light.")
    if not out:
        raise InputError(f"{scene.root}: no modality has a training frame.")
    return out


def _count(usable: np.ndarray | None, directions: np.ndarray) -> int:
    return len(directions) if usable is None else len(usable)


def _compact(values: np.ndarray) -> np.ndarray:
    """float32 in [0, 1] → the integers it came from, when it came from 8 or 16 bit; else as it is."""
    for dtype, full in ((np.uint8, 255.0), (np.uint16, 65535.0)):
        if values.size and values.min() >= 0 and values.max() <= 1:
            integers = np.rint(values * np.float32(full)).astype(dtype)
            if np.array_equal(integers.astype(np.float32) / np.float32(full), values):
                return integers
    return values


def _decode(stored: np.ndarray) -> np.ndarray:
    """Back to float32, 1.0 = full scale."""
    if stored.dtype == np.float32:
        return stored
    return stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
