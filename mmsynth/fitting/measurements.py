"""The training pixels, in memory as they were stored, and random batches of them as rays."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.field import kernels
from mmsynth.fitting.importance import Importance
from mmsynth.fitting.pixels import Pixels
from mmsynth.scene.images import load_frame
from mmsynth.scene.masks import read_mask
from mmsynth.scene.scene import Frame, MaskMeaning, Region, Scene, Sensor
from mmsynth.sensors.camera import Camera, ray_map
from mmsynth.sensors.mosaic import channel_map
from mmsynth.sensors.polarization import analyser_axes


@dataclass(frozen=True)
class Batch:
    """R rays of all modalities in the normalised frame, and the M numbers measured along them.

    Attributes:
        origins, directions: (R, 3). measured: the numbers; those of one modality lie together.
        frame: (M,) int64, counted through the modalities in the order of ``parts``.
        parts: per modality its rays and its numbers.
        alpha: (R,) opacity to match, NaN = none.
        ray_weight: (R,), as rays were drawn more or less often than evenly; within ``measured.weight``, too.
        pixels: of each modality, which of its ``Measurements.pixels`` its rays are.
    """

    origins: Tensor
    directions: Tensor
    measured: kernels.Measured
    frame: Tensor
    parts: dict[str, tuple[slice, slice]]
    alpha: Tensor
    ray_weight: Tensor
    pixels: dict[str, np.ndarray]

    def per_ray(self, values: Mapping[str, float]) -> Tensor:
        """A value for each modality → one for each ray, (R,)."""
        counts = [rays.stop - rays.start for rays, _ in self.parts.values()]
        return torch.from_numpy(np.repeat([values[n] for n in self.parts], counts)).to(self.origins.device)


class Measurements:
    """All training pixels of one modality.

    Integer images stay integers (8 or 16 bit), so a scene takes the memory of its files, decoded, and no more.

    Attributes:
        radiance_scale: the mean of its values, by which residuals are compared with those of other modalities.
        pixels: those whose numbers are learned from: with a ray, and within the mask where masks are ``object`` or ``ignore``.
        empty: those with a ray outside an object's mask: nothing is there. None where no frame says so.
        masked: frames with a mask that is learned from.
    """

    def __init__(self, sensor: Sensor, frames: tuple[Frame, ...], region: Region, masks: MaskMeaning = "off") -> None:
        self.sensor = sensor
        self.cameras: list[Camera] = list(dict.fromkeys(f.camera for f in frames))
        values, alphas = [], []
        for frame in frames:
            pixels, alpha = load_frame(sensor, frame)
            values.append(_compact(pixels.reshape(-1, 1 if pixels.ndim == 2 else pixels.shape[2])))
            alphas.append(alpha)
        self.starts = _begins([len(v) for v in values])
        self.values = _joined(values)
        has_alpha = any(a is not None for a in alphas)
        # a frame without alpha beside frames with one is opaque
        opaque = [np.ones(len(v), np.float32) if a is None else a.reshape(-1) for v, a in zip(values, alphas, strict=True)]
        self.alphas = _joined([_compact(a) for a in opaque]) if has_alpha else None
        self.camera_index = np.array([self.cameras.index(f.camera) for f in frames])
        poses = np.stack([f.camera_to_world for f in frames])
        poses[:, :3, 3] = (poses[:, :3, 3] - np.array(region.centre)) / region.radius
        self.set_poses(poses)
        directions, valid = zip(*(ray_map(camera) for camera in self.cameras), strict=True)
        if not all(v.any() for v in valid):
            raise InputError(f"{sensor.name}: the lens model has no valid ray for any pixel; check its distortion coefficients.")
        # one camera after the other; of each frame, where its camera begins
        self.directions = np.concatenate([d.reshape(-1, 3).astype(np.float32) for d in directions])
        channels = [channel_map(sensor.mosaic, c.height, c.width).reshape(-1) for c in self.cameras if sensor.mosaic is not None]
        self.channels = np.concatenate(channels) if channels else None
        self.first = _begins([v.size for v in valid])[self.camera_index]
        self.masked = 0 if masks == "off" else sum(frame.mask is not None for frame in frames)
        of_frames = [valid[index].reshape(-1) for index in self.camera_index]
        self.pixels, self.empty = _inside(frames, of_frames, masks) if self.masked else (Pixels(of_frames), None)
        if not self.pixels.size:
            raise InputError(
                f"{frames[0].mask}: this mask of {sensor.name} and those of all its other training frames are empty, "
                "expected pixels that are not zero."
            )
        drawn, pixel = self.pick(min(self.pixels.size, 1 << 18), np.random.default_rng(0))
        self.radiance_scale = float(self.read(drawn, pixel)[0].mean())

    def set_poses(self, poses: np.ndarray) -> None:
        """Let the frames be at (F, 4, 4) camera_to_world, normalised frame."""
        self.rotations = poses[:, :3, :3].astype(np.float32)
        self.origins = poses[:, :3, 3].astype(np.float32)

    @property
    def has_opacity(self) -> bool:
        """Whether frames say where something is and where nothing: by alpha, or by masks of an object."""
        return self.alphas is not None or self.empty is not None

    def pick(self, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """``count`` pixels, uniform over all frames with replacement: frame and pixel indices, (count,) each."""
        return self.pixels.at(random.integers(0, self.pixels.size, count))

    def rays(self, frame: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions, (N, 3) float32 each, normalised frame."""
        in_camera = self.directions[self.first[frame] + pixel]
        return self.origins[frame], np.einsum("nij,nj->ni", self.rotations[frame], in_camera)

    def read(self, frame: np.ndarray, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Values (N, K) and alpha (N,) or None, float32. With alpha, values are premultiplied: what the object adds to black."""
        index = self.starts[frame] + pixel
        target = _decode(self.values[index])
        if self.alphas is None:
            return target, None
        alpha = _decode(self.alphas[index])
        return target * alpha[:, None], alpha

    def measured(self, frame: np.ndarray, pixel: np.ndarray) -> np.ndarray | None:
        """Channel that each pixel of a mosaic measures, (N,) int64; None when pixels measure all channels."""
        return None if self.channels is None else self.channels[self.first[frame] + pixel]


def in_order(measurements: dict[str, Measurements]) -> list[str]:
    """The modalities as batches hold them: polarization last."""
    return sorted(measurements, key=lambda n: measurements[n].sensor.is_polarization)


def draw(
    measurements: dict[str, Measurements],
    columns: dict[str, slice],
    rays: dict[str, int],
    random: np.random.Generator,
    device: torch.device,
    importance: Importance | None = None,
) -> Batch:
    """A random batch.

    Args:
        columns: the shader outputs of each modality. rays: how many of each modality. importance: how often to draw each pixel, all
            alike when None.
    """
    order = in_order(measurements)
    parts: dict[str, tuple[slice, slice]] = {}
    lists: dict[str, list[np.ndarray]] = {"axes": [np.empty((0, 3), np.float32)]}
    numbers: dict[str, np.ndarray] = {}
    r_end = m_end = frames = 0
    for name in order:
        m, count = measurements[name], rays[name]
        if importance is None:
            numbers[name], weight = random.integers(0, m.pixels.size, count), np.ones(count, np.float32)
        else:
            numbers[name], weight = importance.draw(name, count, random)
        frame, pixel = m.pixels.at(numbers[name])
        origins, directions = m.rays(frame, pixel)
        target, alpha = m.read(frame, pixel)
        channel = m.measured(frame, pixel)
        values = target.shape[1]
        if m.sensor.polarizer_angles_deg is not None:
            angles = np.deg2rad(np.array(m.sensor.polarizer_angles_deg, np.float32))
            angle = angles[channel][:, None] if channel is not None else np.tile(angles, (count, 1))
            camera_x = torch.from_numpy(np.ascontiguousarray(m.rotations[frame][:, :, 0]))
            axes = analyser_axes(torch.from_numpy(directions), camera_x, torch.from_numpy(angle))
            lists["axes"].append(axes.numpy().reshape(-1, 3))
            output = np.full(count * values, columns[name].start)
        elif channel is not None:
            output = columns[name].start + channel
        else:
            output = np.tile(np.arange(columns[name].start, columns[name].stop), count)
        of_all = {"level": m.radiance_scale, "saturation": m.sensor.saturation}
        drawn = {
            "origins": origins,
            "directions": directions,
            "target": target.reshape(-1),
            "ray": np.repeat(np.arange(r_end, r_end + count), values),
            "output": output,
            "frame": np.repeat(frame + frames, values),
            "weight": np.repeat(weight / np.float32(len(order) * target.size), values),
            "ray_weight": weight,
            "alpha": np.full(count, np.nan if m.empty is None else 1.0, np.float32) if alpha is None else alpha,
            **{key: np.full(target.size, value, np.float32) for key, value in of_all.items()},
        }
        for key, value in drawn.items():
            lists.setdefault(key, []).append(value)
        parts[name] = slice(r_end, r_end + count), slice(m_end, m_end + target.size)
        r_end, m_end, frames = r_end + count, m_end + target.size, frames + len(m.origins)
    joined = {key: torch.from_numpy(np.concatenate(values)).to(device) for key, values in lists.items()}
    measured = kernels.Measured(*(joined.pop(key) for key in kernels.Measured._fields))
    return Batch(**joined, measured=measured, parts=parts, pixels=numbers)


def draw_empty(
    measurements: dict[str, Measurements], rays: dict[str, int], random: np.random.Generator, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Random rays along which nothing is, as masks of an object say: origins and directions, (R, 3) each.

    Args:
        rays: how many of each modality; those without such masks give none.
    """
    found = [m.rays(*m.empty.at(random.integers(0, m.empty.size, rays[n]))) for n, m in measurements.items() if m.empty is not None]
    origins, directions = (torch.from_numpy(np.concatenate(part)).to(device) for part in zip(*found, strict=True))
    return origins, directions


def load_measurements(scene: Scene) -> dict[str, Measurements]:
    """Training pixels per modality.

    Raises:
        InputError: an image or a mask is missing, broken or of the wrong size; a modality has no light in any training frame, or its
            masks are all empty.
    """
    out = {}
    for name, sensor in scene.sensors.items():
        frames = scene.frames_of(name, scene.split.train)
        if not frames:
            continue
        out[name] = Measurements(sensor, frames, scene.region, scene.masks)
        if not out[name].radiance_scale > 0:
            raise InputError(f"{frames[0].path.parent}: all training frames of {name} are black, expected some light.")
    if not out:
        raise InputError(f"{scene.root}: no modality has a training frame.")
    return out


def fingerprint(measurements: Mapping[str, Measurements]) -> str:
    """Hash of the pixels that are learned from, and of their poses."""
    digest = hashlib.sha256()
    for name, m in measurements.items():
        digest.update(name.encode())
        for part in (m.origins, m.rotations, m.values):
            digest.update(np.ascontiguousarray(part).tobytes())
        for chosen in (m.pixels, m.empty) if m.masked else ():
            digest.update(b"" if chosen is None or chosen.bits is None else chosen.bits.tobytes())
    return digest.hexdigest()[:16]


def _inside(frames: tuple[Frame, ...], valid: list[np.ndarray], masks: MaskMeaning) -> tuple[Pixels, Pixels | None]:
    """``pixels`` and ``empty`` of ``Measurements``; ``valid``: (P,) of each frame.

    A frame without a mask beside frames with one: to ignore nothing is to learn from all of it; but what in it is not the object,
    nobody knows, and nothing is learned from it.
    """
    inside, outside = [], []
    for frame, usable in zip(frames, valid, strict=True):
        mask = read_mask(frame)
        if mask is None:
            mask = np.full(usable.shape, masks == "ignore")
            usable = usable & mask
        inside.append(usable & mask.reshape(-1))
        if masks == "object":
            outside.append(usable & ~mask.reshape(-1))
    empty = Pixels(outside) if outside else None
    return Pixels(inside), empty if empty is not None and empty.size else None


def _begins(counts: list[int]) -> np.ndarray:
    """Where each of several parts begins that lie one after the other."""
    return np.cumsum([0, *counts])[:-1]


def _compact(values: np.ndarray) -> np.ndarray:
    """float32 in [0, 1] → the integers it came from, when it came from 8 or 16 bit; else as it is."""
    for dtype in (np.uint8, np.uint16):
        if values.size and values.min() >= 0 and values.max() <= 1:
            integers = np.rint(values * np.float32(np.iinfo(dtype).max)).astype(dtype)
            if np.array_equal(_decode(integers), values):
                return integers
    return values


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    """One array of all frames; frames stored in different ways are decoded first."""
    same = len({p.dtype for p in parts}) == 1
    return np.concatenate(parts if same else [_decode(p) for p in parts])


def _decode(stored: np.ndarray) -> np.ndarray:
    """Back to float32, 1.0 = full scale."""
    return stored if stored.dtype == np.float32 else stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
