"""The training pixels, or as many of their rows as a fit needs, in memory as they were stored, and random batches of them as rays."""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.field import kernels
from mmsynth.fitting.directions import pixel_directions
from mmsynth.fitting.kept_rows import Kept, kept_of
from mmsynth.fitting.stored_frames import KINDS, OnLoad, in_threads, read_frames
from mmsynth.fitting.tiles import Tile, Tiled, all_pixels, joined, selection_of, some_pixels, tile_size
from mmsynth.scene.masks import read_mask
from mmsynth.scene.scene import Frame, MaskMeaning, Region, Scene, Sensor
from mmsynth.sensors.camera import Camera

Table = TypeVar("Table", kernels.Frames, kernels.Cameras, kernels.Modalities, kernels.Selection)
_TYPICAL = 1 << 18  # pixels, by which the level of a modality is known


@dataclass(frozen=True)
class Batch:
    """R rays of all modalities in the normalised frame, and the M numbers measured along them.

    Attributes:
        origins, directions: (R, 3). jitter: (R,) random numbers in [0, 1), for the samples along rays.
        measured: the numbers; those of one modality lie together.
        frame: (M,) int64, counted through the modalities in the order of batches.
        parts: per modality its rays and its numbers.
        alpha: (R,) opacity to match, NaN = none.
        ray_weight: (R,), as rays were drawn more or less often than evenly; within ``measured.weight``, too.
        tile: (R,) int64, that of each ray's pixel.
    """

    origins: Tensor
    directions: Tensor
    jitter: Tensor
    measured: kernels.Measured
    frame: Tensor
    parts: dict[str, tuple[slice, slice]]
    alpha: Tensor
    ray_weight: Tensor
    tile: Tensor

    def per_ray(self, values: Mapping[str, float]) -> Tensor:
        """A value for each modality → one for each ray, (R,)."""
        counts = [rays.stop - rays.start for rays, _ in self.parts.values()]
        return torch.from_numpy(np.repeat([values[n] for n in self.parts], counts)).to(self.origins.device)


@dataclass
class Modality:
    """What is known of the training frames of a sensor.

    Attributes:
        cameras: without repetition. camera_index: (F,), of each frame.
        rotations, origins: (F, 3, 3), (F, 3) float32, camera to world, normalised frame.
        digests: of each frame, a hash of its values. views: (F,) int, which it is of.
        total: how many pixels. pixels: of these, how many numbers are learned from: with a ray, and within the mask where masks are
            ``object`` or ``ignore``. empty: with a ray outside an object's mask: nothing is there. every: from one row that is kept to the
            next; if it is not 1, pixels and empty are as many as they would be of all rows.
        masked: frames with a mask that is learned from. has_alpha: whether a frame has alpha.
        radiance_scale: the mean of its values, by which residuals are compared with those of other modalities.
    """

    sensor: Sensor
    cameras: list[Camera]
    camera_index: np.ndarray
    rotations: np.ndarray
    origins: np.ndarray
    digests: Sequence[bytes]
    views: np.ndarray
    total: int
    pixels: int
    empty: int
    masked: int
    has_alpha: bool
    every: int = 1
    radiance_scale: float = math.nan

    @property
    def values(self) -> int:
        """Numbers that are measured along a ray."""
        return self.sensor.values_per_pixel

    @property
    def has_opacity(self) -> bool:
        """Whether frames say where something is and where nothing: by alpha, or by masks of an object."""
        return self.has_alpha or self.empty > 0


@dataclass
class Measurements(Mapping[str, Modality]):
    """All training pixels of a scene, by modality, and the tables by which kernels draw them, on one device.

    Attributes:
        of: the modalities. order: as batches hold them: polarization last.
        frames, cameras, modalities: in this order.
        chosen: the pixels that are learned from, all equally often. empty: those where nothing is, None where no frame says so.
    """

    of: dict[str, Modality]
    order: tuple[str, ...]
    frames: kernels.Frames
    cameras: kernels.Cameras
    modalities: kernels.Modalities
    chosen: kernels.Selection
    empty: kernels.Selection | None

    def __getitem__(self, name: str) -> Modality:
        return self.of[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.of)

    def __len__(self) -> int:
        return len(self.of)

    def set_poses(self, name: str, poses: np.ndarray) -> None:
        """Let the frames of a modality be at (F, 4, 4) camera_to_world, normalised frame."""
        m = self.of[name]
        m.rotations, m.origins = _rotations_origins(poses)
        first = sum(len(self.of[n].origins) for n in self.order[: self.order.index(name)])
        for all_frames, own in ((self.frames.rotation, m.rotations), (self.frames.origin, m.origins)):
            all_frames[first : first + len(own)] = torch.from_numpy(own)


@functools.lru_cache(maxsize=8)
def _integers(values: tuple[int, ...], device: torch.device) -> Tensor:
    return torch.tensor(values, dtype=torch.int32, device=device)


def drawing_of(
    measurements: Measurements,
    columns: Mapping[str, slice] | None,
    rays: Mapping[str, int],
    random: np.random.Generator,
    selection: kernels.Selection | None = None,
) -> kernels.Drawing:
    """What kernels draw for a random batch, see ``draw``."""
    modalities = measurements.modalities
    if columns is not None:
        begins = tuple(columns[n].start if n in rays else 0 for n in measurements.order)
        modalities = modalities._replace(output=_integers(begins, modalities.output.device))
    first, second = random.integers(0, 1 << 32, 2).tolist()
    return kernels.Drawing(
        measurements.frames, measurements.cameras, modalities, measurements.chosen if selection is None else selection,
        [rays.get(n, 0) for n in measurements.order], (first, second),
    )  # fmt: skip


def batch_of(measurements: Measurements, rays: Mapping[str, int], drawn: kernels.Drawn) -> Batch:
    """What was drawn, so many rays of some modalities."""
    parts: dict[str, tuple[slice, slice]] = {}
    r = m = 0
    for name in (n for n in measurements.order if n in rays):
        count, numbers = rays[name], rays[name] * measurements[name].values
        parts[name] = slice(r, r + count), slice(m, m + numbers)
        r, m = r + count, m + numbers
    return Batch(**drawn._asdict(), parts=parts)


def draw(
    measurements: Measurements,
    columns: Mapping[str, slice] | None,
    rays: Mapping[str, int],
    random: np.random.Generator,
    selection: kernels.Selection | None = None,
) -> Batch:
    """A random batch.

    Args:
        columns: the shader outputs of each modality, None: each from 0. rays: how many of some modalities.
        selection: of which pixels, and how often each; None: of all that are learned from, all alike.
    """
    return batch_of(measurements, rays, kernels.draw(*drawing_of(measurements, columns, rays, random, selection)))


def empty_drawing_of(measurements: Measurements, rays: Mapping[str, int], random: np.random.Generator) -> kernels.Drawing:
    """Random rays along which nothing is, as masks of an object say; what is measured along them means nothing.

    Args:
        rays: how many of each modality; those without such masks give none.
    """
    some = {n: count for n, count in rays.items() if measurements[n].empty}
    return drawing_of(measurements, None, some, random, measurements.empty)


def load_measurements(
    scene: Scene, *, rays_to_come: float = math.inf, device: torch.device | str = "cpu", on_load: OnLoad | None = None
) -> Measurements:
    """Training pixels of all modalities.

    Args:
        rays_to_come: how many a fit will draw, about: by it are tiles, and rows that are kept. on_load: news of what was read.
    Raises:
        InputError: as ``measure``; there is no training frame; a modality has no light in any of them.
    """
    frames = {name: (sensor, scene.frames_of(name, scene.split.train)) for name, sensor in scene.sensors.items()}
    frames = {name: (sensor, listed) for name, (sensor, listed) in frames.items() if listed}
    if not frames:
        raise InputError(f"{scene.root}: no modality has a training frame.")
    out = measure(frames, scene.region, scene.masks, rays_to_come=rays_to_come, device=device, on_load=on_load)
    for name, m in out.items():
        if not m.radiance_scale > 0:
            raise InputError(f"{frames[name][1][0].path.parent}: all training frames of {name} are black, expected some light.")
    return out


def measure(
    frames: Mapping[str, tuple[Sensor, tuple[Frame, ...]]],
    region: Region,
    masks: MaskMeaning = "off",
    *,
    rays_to_come: float = math.inf,
    device: torch.device | str = "cpu",
    on_load: OnLoad | None = None,
) -> Measurements:
    """``load_measurements`` of sensors and their frames.

    Raises:
        InputError: an image or a mask is missing, broken or of the wrong size; they do not fit into memory; a lens has no ray; the masks of
            a modality are all empty.
    """
    order = tuple(sorted(frames, key=lambda n: frames[n][0].is_polarization))
    sensors, listed = [frames[n][0] for n in order], [frames[n][1] for n in order]
    totals = [sum(f.camera.width * f.camera.height for f in of_sensor) for of_sensor in listed]
    kept = kept_of([frames[n] for n in order], rays_to_come)
    pairs = [(sensor, frame) for sensor, of_sensor in zip(sensors, listed, strict=True) for frame in of_sensor]
    stored = read_frames(pairs, [k for of_sensor in kept for k in of_sensor], on_load)
    cameras = [list(dict.fromkeys(k.camera for k in of_sensor)) for of_sensor in kept]
    directions, has_ray = pixel_directions([c for of_sensor in cameras for c in of_sensor])
    first_frame, first_camera = _begins(map(len, listed)), _begins(map(len, cameras))
    counts = [sum(k.camera.width * k.camera.height for k in of_sensor) for of_sensor in kept]
    tiles = [tile_size(count, rays_to_come / len(order)) for count in counts]
    of, camera_of, chosen, empty = {}, [], [], []
    for n, (name, sensor, of_sensor) in enumerate(zip(order, sensors, listed, strict=True)):
        camera_of.append(first_camera[n] + np.array([cameras[n].index(k.camera) for k in kept[n]]))
        usable = [has_ray[c] for c in camera_of[n]]
        if not all(rays is None or rays.any() for rays in usable):
            raise InputError(f"{name}: the lens model has no valid ray for any pixel; check its distortion coefficients.")
        masked = 0 if masks == "off" else sum(f.mask is not None for f in of_sensor)
        inside, outside = _inside_outside(of_sensor, kept[n], usable, masks if masked else "off", tiles[n])
        if not inside.pixels.any():
            raise InputError(
                f"{of_sensor[0].mask}: this mask of {name} and those of all its other training frames are empty, "
                "expected pixels that are not zero."
            )
        chosen.append(inside)
        empty.append(outside)
        poses = np.stack([f.camera_to_world for f in of_sensor])
        poses[:, :3, 3] = (poses[:, :3, 3] - np.array(region.centre)) / region.radius
        own, of_each = slice(first_frame[n], first_frame[n + 1]), totals[n] / counts[n]
        lenses = list(dict.fromkeys(f.camera for f in of_sensor))
        has_alpha = bool((stored.stride[own] > sensor.values_per_pixel).any())
        of[name] = Modality(
            sensor, lenses, np.array([lenses.index(f.camera) for f in of_sensor]), *_rotations_origins(poses), stored.digest[own],
            np.array([f.view for f in of_sensor]), totals[n], round(of_each * int(inside.pixels.sum())),
            round(of_each * int(outside.pixels.sum())), masked, has_alpha, kept[n][0].rows.step,
        )  # fmt: skip
    tiled = [(tile, k.camera) for tile, of_sensor in zip(tiles, kept, strict=True) for k in of_sensor]
    first_tile = _begins(math.prod(tile.down_across(c.height, c.width)) for tile, c in tiled)
    ordered = [of[n] for n in order]
    frame_table = kernels.Frames(
        torch.from_numpy(stored.start), torch.from_numpy(stored.kind), torch.from_numpy(stored.stride), _whole(np.concatenate(camera_of)),
        _whole(first_tile[:-1]), torch.from_numpy(np.concatenate([m.rotations for m in ordered])),
        torch.from_numpy(np.concatenate([m.origins for m in ordered])),
        *(torch.from_numpy(stored.data.view(kind)) for kind in KINDS),
    )  # fmt: skip
    modalities = _modality_table(ordered, first_frame, first_tile[first_frame], tiles)
    selected = selection_of(chosen, modalities.first_tile)
    nothing = selection_of(empty, modalities.first_tile) if any(m.empty for m in ordered) else None
    out = Measurements({n: of[n] for n in frames}, order, frame_table, directions, modalities, selected, nothing)
    return _on(_with_levels(out), device)


def fingerprint(measurements: Measurements) -> str:
    """Hash of the pixels that are learned from, and of their poses."""
    digest = hashlib.sha256()
    for name in measurements.order:
        m = measurements[name]
        digest.update(name.encode())
        for part in (m.origins, m.rotations):
            digest.update(np.ascontiguousarray(part).tobytes())
        for frame in m.digests:
            digest.update(frame)
    if any(m.masked for m in measurements.values()):
        for selection in (measurements.chosen, measurements.empty):
            digest.update(b"" if selection is None else selection.words.cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


def _inside_outside(
    frames: Sequence[Frame], kept: Sequence[Kept], usable: Sequence[np.ndarray | None], masks: MaskMeaning, tile: Tile
) -> tuple[Tiled, Tiled]:
    """The pixels of a modality that are learned from, and those where nothing is.

    A frame without a mask beside frames with one: to ignore nothing is to learn from all of it; but what in it is not the object,
    nobody knows, and nothing is learned from it.

    Args:
        kept: what of each frame. usable: of that (H, W) bool, which pixels have a ray, None = all.
    """
    shapes = [(k.camera.height, k.camera.width) for k in kept]
    none = all_pixels(shapes, tile)
    none = none._replace(pixels=np.zeros_like(none.pixels))
    if masks == "off" and all(rays is None for rays in usable):
        return all_pixels(shapes, tile), none

    def of_frame(i: int) -> tuple[Tiled, Tiled | None]:
        has_ray = usable[i]
        rays = np.ones(shapes[i], bool) if has_ray is None else has_ray
        whole = None if masks == "off" else read_mask(frames[i])
        if whole is None:
            learned = rays if masks != "object" else np.zeros_like(rays)
            return some_pixels(learned, tile), some_pixels(np.zeros_like(rays), tile) if masks == "object" else None
        mask = whole[kept[i].rows]
        return some_pixels(rays & mask, tile), some_pixels(rays & ~mask, tile) if masks == "object" else None

    inside, outside = zip(*in_threads(of_frame, len(frames)), strict=True)
    return joined(inside), joined(outside) if masks == "object" else none


def _modality_table(
    modalities: Sequence[Modality], first_frame: np.ndarray, first_tile: np.ndarray, tiles: Sequence[Tile]
) -> kernels.Modalities:
    """What kernels are told of modalities; levels and outputs are not known yet."""
    patterns = [np.empty((0, 0), np.int64) if m.sensor.mosaic is None else m.sensor.mosaic for m in modalities]
    angles = [np.deg2rad(m.sensor.polarizer_angles_deg or ()) for m in modalities]
    known = lambda begins, parts: [int(begin) if np.size(part) else -1 for begin, part in zip(begins, parts, strict=False)]
    single = lambda values: torch.tensor(values, dtype=torch.float32)
    analysers = np.concatenate([np.stack([np.cos(a), np.sin(a)], -1) for a in angles])
    return kernels.Modalities(
        first_frame=_whole(first_frame),
        first_tile=_whole(first_tile),
        tile_width=_whole([t.width for t in tiles]),
        tile_height=_whole([t.height for t in tiles]),
        values=_whole([m.values for m in modalities]),
        output=_whole([0] * len(modalities)),
        pattern_first=_whole(known(_begins(map(np.size, patterns)), patterns)),
        pattern_height=_whole([p.shape[0] for p in patterns]),
        pattern_width=_whole([p.shape[1] for p in patterns]),
        pattern=_whole(np.concatenate([p.reshape(-1) for p in patterns])),
        level=single([1.0] * len(modalities)),
        saturation=single([m.sensor.saturation for m in modalities]),
        opaque=single([1.0 if m.has_opacity else math.nan for m in modalities]),
        analyser_first=_whole(known(_begins(map(len, angles)), angles)),
        analysers=torch.from_numpy(analysers.astype(np.float32)),
    )


def _with_levels(measurements: Measurements) -> Measurements:
    for name, m in measurements.items():
        values = draw(measurements, None, {name: min(m.pixels, _TYPICAL)}, np.random.default_rng(0)).measured.target
        m.radiance_scale = float(values.double().mean())
    level = torch.tensor([measurements[n].radiance_scale for n in measurements.order], dtype=torch.float32)
    return replace(measurements, modalities=measurements.modalities._replace(level=level))


def _on(measurements: Measurements, device: torch.device | str) -> Measurements:
    m, f = measurements, measurements.frames
    buffer = f.codes8.to(device)  # once: the others are views of it
    views = {"codes8": buffer, "codes16": buffer.view(torch.uint16), "floats": buffer.view(torch.float32)}
    frames = _moved(f._replace(**views), device)
    return Measurements(
        m.of, m.order, frames, _moved(m.cameras, device), _moved(m.modalities, device), _moved(m.chosen, device),
        None if m.empty is None else _moved(m.empty, device),
    )  # fmt: skip


def _moved(table: Table, device: torch.device | str) -> Table:
    return type(table)(*(x.to(device) for x in table))


def _rotations_origins(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 4, 4) → (F, 3, 3), (F, 3) float32."""
    return poses[:, :3, :3].astype(np.float32), poses[:, :3, 3].astype(np.float32)


def _whole(values: Sequence[int] | np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(values, np.int32))


def _begins(counts: Iterable[int]) -> np.ndarray:
    """Where each of several parts begins that lie one after the other, and where the last one ends."""
    return np.cumsum([0, *counts])
