"""A folder of calibration frames: ``BOARDS/<sensor>/<instant>.<suffix>``; equal names are one instant of the rig.

Pictures in the folder itself are those of one sensor of the folder's name. A folder ``modalities`` in between is passed over, as
MMS-DATA's source scenes have it. What a sensor's name does not tell of its mosaic may be stated by a ``calibration.json`` in the folder,
whose geometry is not looked at.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.capture.board import Board
from mmsynth.scene.capture.detection import Detection, find_boards
from mmsynth.scene.images import SUFFIXES, read_image
from mmsynth.scene.known_sensors import DESCRIBED_BY, KNOWN, make_sensor
from mmsynth.scene.scene import canonical_modality

_TILES = (2, 3, 4, 5)
_UNEVEN = 0.04  # relative difference of a tile's places from which a picture is a mosaic


@dataclass(frozen=True)
class SensorFrames:
    """The frames of one sensor.

    Attributes:
        name: canonical. source_name: its folder. files: by instant. size: width and height.
        pattern: of the mosaic; None: there is none, or (``tile``) its channels are not known.
        tile: rows and columns after which the mosaic repeats.
        described: keys that describe it in ``calibration.json``.
        found: boards by instant. digests: of the frames' pixels, by instant.
    """

    name: str
    source_name: str
    files: Mapping[str, Path]
    size: tuple[int, int]
    tile: tuple[int, int]
    described: Mapping[str, Any]
    found: Mapping[str, Sequence[Detection]] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)

    @property
    def same(self) -> dict[str, str]:
        """Instants whose picture is that of an earlier one: that one."""
        first: dict[str, str] = {}
        for instant, digest in self.digests.items():
            first.setdefault(digest, instant)
        return {instant: first[digest] for instant, digest in self.digests.items() if first[digest] != instant}


def list_frames(folder: Path) -> dict[str, SensorFrames]:
    """The sensors of a folder, by canonical name, without looking for boards.

    Raises:
        InputError: no such folder, no pictures, or two folders of one sensor.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected one with a folder of calibration frames for each sensor.")
    root = folder / "modalities" if (folder / "modalities").is_dir() else folder
    groups = {child.name: files for child in sorted(root.iterdir()) if child.is_dir() and (files := _pictures(child))}
    if not groups and (own := _pictures(root)):
        groups = {root.resolve().name: own}
    if not groups:
        raise InputError(f"{folder}: no pictures, expected {folder.name}/SENSOR/INSTANT{SUFFIXES[0]} with calibration boards.")
    for name, count in Counter(map(canonical_modality, groups)).items():
        if count > 1:
            raise InputError(f"{folder}: {count} folders are called '{name}' or an alias of it, expected one.")
    stated = read_json(folder / "calibration.json") if (folder / "calibration.json").is_file() else {}
    entries = stated if isinstance(stated, dict) else {}
    return {canonical_modality(source): _sensor(source, files, entries.get(source, {})) for source, files in groups.items()}


def _pictures(folder: Path) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.is_file() and path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            if path.stem in files:
                raise InputError(f"{path}: a second frame '{path.stem}' of one sensor beside {files[path.stem].name}, expected one.")
            files[path.stem] = path
    return files


def _sensor(source: str, files: Mapping[str, Path], entry: Any) -> SensorFrames:
    name, first = canonical_modality(source), next(iter(files.values()))
    raw = read_image(first)
    described = {key: entry[key] for key in DESCRIBED_BY if key in entry} if isinstance(entry, dict) else {}
    tile, size = (1, 1), (raw.shape[1], raw.shape[0])
    if raw.ndim == 2 and (described or name in KNOWN):
        mosaic = make_sensor(name, described, str(first), raw, raw=True).mosaic
        tile = (1, 1) if mosaic is None else (mosaic.shape[0], mosaic.shape[1])
        described.setdefault("mosaick_pattern", [[0]] if mosaic is None else mosaic.tolist())
    elif raw.ndim == 2:
        tile = tile_of(raw)
        if tile == (1, 1):
            described["mosaick_pattern"] = [[0]]
    return SensorFrames(name, source, files, size, tile, described)


def tile_of(raw: np.ndarray) -> tuple[int, int]:
    """After how many rows and columns a frame's brightness repeats: (1, 1) where it is no mosaic."""
    uneven = {1: 0.0}
    for n in _TILES:
        rows, columns = raw.shape[0] // n, raw.shape[1] // n
        if min(rows, columns) < 4:
            continue
        blocks = raw[: rows * n, : columns * n].reshape(rows, n, columns, n).astype(np.float64)
        means = blocks.mean((0, 2))
        # what noise and the scene's own detail make of places that are alike
        chance = (blocks - blocks.mean((1, 3), keepdims=True)).std() / np.sqrt(rows * columns)
        uneven[n] = max(0.0, float(means.std() - 2 * chance)) / max(float(means.mean()), 1e-12)
    best = max(uneven.values())
    n = min((n for n, value in uneven.items() if value > 0.8 * best), default=1)
    return (n, n) if best > _UNEVEN else (1, 1)


def find_in_frames(
    sensor: SensorFrames, boards: Sequence[Board], workers: int = 1, progress: Any = None, done: int = 0, total: int = 0
) -> SensorFrames:
    """The same sensor with the boards in its frames.

    Raises:
        InputError: a frame cannot be read, or has another size than the first.
    """
    digests: dict[str, str] = {}

    def look(item: tuple[str, Path]) -> tuple[str, str, list[Detection]]:
        instant, path = item
        raw = read_image(path)
        if (raw.shape[1], raw.shape[0]) != sensor.size:
            raise InputError(
                f"{path}: {raw.shape[1]}x{raw.shape[0]} pixels, expected {sensor.size[0]}x{sensor.size[1]} as the first of its sensor."
            )
        pattern = None if sensor.tile == (1, 1) else np.zeros(sensor.tile, int)
        return instant, hashlib.sha256(np.ascontiguousarray(raw).tobytes()).hexdigest(), find_boards(raw, boards, pattern)

    found: dict[str, Sequence[Detection]] = {}
    with ThreadPoolExecutor(workers) as pool:
        for instant, digest, detections in pool.map(look, sensor.files.items()):
            found[instant] = detections
            digests[instant] = digest
            done += 1
            if progress is not None:
                progress(done, total)
    return replace(sensor, found=found, digests=digests)
