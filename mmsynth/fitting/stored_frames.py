"""The frames of a fit in memory, as their files store them: integers stay integers, and no frame is there twice."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from mmsynth.errors import InputError
from mmsynth.fitting.kept_rows import Kept
from mmsynth.scene.images import decode, stored_frame
from mmsynth.scene.scene import Frame, Sensor
from mmsynth.sensors.camera import Camera
from mmsynth.threads import usable_cores

T = TypeVar("T")
KINDS = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
OnLoad = Callable[[int, int], None]
"""Called as ``on_load(done, total)``, in frames."""
_ALIGNED = 4  # bytes: where a frame begins, whatever its kind
_THREADS = 8  # at most: each holds a file and a frame


class StoredFrames(NamedTuple):
    """F frames, one after the other.

    Attributes:
        data: (bytes,) uint8. start: (F,) int64, the first value of each, counted in values of its kind. kind: (F,) in ``KINDS``.
        stride: (F,), values of a pixel. digest: of each frame, a hash of its values.
    """

    data: np.ndarray
    start: np.ndarray
    kind: np.ndarray
    stride: np.ndarray
    digest: list[bytes]


def read_frames(frames: Sequence[tuple[Sensor, Frame]], kept: Sequence[Kept] | None = None, on_load: OnLoad | None = None) -> StoredFrames:
    """Read the frames of several sensors, some at a time.

    Room is made once, by the first frame of each sensor; frames that are stored in a wider way than that stand behind the others.

    Args:
        kept: what of each frame; None: all. Digests are of all.
    Raises:
        InputError: as ``scene.images.load_frame``, for the first such frame; there is not enough memory for them.
    """
    firsts = {sensor.name: i for i, (sensor, _) in reversed(list(enumerate(frames)))}
    patterns = {name: _compact(stored_frame(*frames[i])) for name, i in firsts.items()}
    held = [Kept(slice(None), frame.camera) for _, frame in frames] if kept is None else kept
    sizes = [_room(part.camera, patterns[sensor.name]) for (sensor, _), part in zip(frames, held, strict=True)]
    begins = np.cumsum([0, *sizes])
    data = _reserved(int(begins[-1]), [frame for _, frame in frames])
    start, kind, stride = np.zeros(len(frames), np.int64), np.zeros(len(frames), np.int32), np.zeros(len(frames), np.int32)
    digest: list[bytes] = [b""] * len(frames)
    wider: dict[int, np.ndarray] = {}

    def read(i: int) -> None:
        stored = np.ascontiguousarray(_compact(stored_frame(*frames[i])))
        kind[i], stride[i] = KINDS.index(stored.dtype), stored.shape[2]
        digest[i] = hashlib.sha256(stored.data).digest()
        flat = np.ascontiguousarray(stored[held[i].rows]).reshape(-1).view(np.uint8)
        if len(flat) <= sizes[i]:
            data[begins[i] : begins[i] + len(flat)] = flat
            start[i] = begins[i] // stored.dtype.itemsize
        else:
            wider[i] = np.pad(flat, (0, -len(flat) % _ALIGNED))

    in_threads(read, len(frames), on_load)
    behind = len(data)
    for i in wider:
        start[i] = behind // KINDS[kind[i]].itemsize
        behind += len(wider[i])
    return StoredFrames(np.concatenate([data, *wider.values()]) if wider else data, start, kind, stride, digest)


def in_threads(work: Callable[[int], T], count: int, on_load: OnLoad | None = None) -> list[T]:
    """Work on each of ``count`` frames, some at a time: what it gives, in their order. The first that fails ends it."""
    out = []
    pool = ThreadPoolExecutor(min(_THREADS, usable_cores()))
    try:
        for done in pool.map(work, range(count)):
            out.append(done)
            if on_load is not None:
                on_load(len(out), count)
    finally:
        pool.shutdown(cancel_futures=True)
    return out


def _room(camera: Camera, like: np.ndarray) -> int:
    """Bytes of a frame of this camera that is stored as another one of its sensor."""
    size = camera.width * camera.height * like.shape[2] * like.dtype.itemsize
    return size + -size % _ALIGNED


def _reserved(size: int, frames: Sequence[Frame]) -> np.ndarray:
    available = available_memory()
    if available is not None and size > available:
        raise InputError(
            f"{frames[0].path.parent}: {len(frames)} training frames take {size / 1e9:.1f} GB in memory, {available / 1e9:.1f} GB are "
            "available; fit fewer frames (--frames) or modalities (--modalities)."
        )
    return np.empty(size, np.uint8)


def available_memory() -> int | None:
    """Bytes that this process may still use; None where the system does not say."""
    meminfo = Path("/proc/meminfo")
    if not meminfo.is_file():
        return None
    lines = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    return int(lines["MemAvailable"].split()[0]) * 1024 if "MemAvailable" in lines else None


def _compact(stored: np.ndarray) -> np.ndarray:
    """float32 in [0, 1] → the integers it came from, when it came from 8 or 16 bit; else as it is."""
    if stored.dtype.kind == "u" or not (stored.min() >= 0 and stored.max() <= 1):
        return stored
    for dtype in KINDS[:2]:
        integers = np.rint(stored * np.float32(np.iinfo(dtype).max)).astype(dtype)
        if np.array_equal(decode(integers), stored):
            return integers
    return stored
