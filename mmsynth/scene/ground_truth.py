"""Ground truth of a scene, from its ``gt`` folder: noise-free radiance, geometry, regions."""

from __future__ import annotations

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.images import read_npz
from mmsynth.scene.scene import Frame, Scene, canonical_modality


class GroundTruth:
    """The scene's ``gt`` folder. Every method gives None (or nothing) where it has no file, and raises InputError for a damaged one."""

    def __init__(self, scene: Scene) -> None:
        self.folder = scene.root / "gt"

    def arrays(self, *parts: str) -> dict[str, np.ndarray] | None:
        """All arrays of one npz file, by its path in the folder."""
        path = self.folder.joinpath(*parts)
        return read_npz(path) if path.is_file() else None

    def image(self, frame: Frame) -> np.ndarray | None:
        """(H, W, C), or Stokes (H, W, 3), at the frame's own pose."""
        found = self.arrays(frame.source_name or frame.sensor, f"{frame.view:04d}.npz")
        return None if found is None or "data" not in found else found["data"].astype(np.float32)

    def region(self, frame: Frame) -> np.ndarray | None:
        """(H, W) bool: where the frame sees the region of interest."""
        found = self.arrays("masks", f"{frame.view:04d}_{frame.source_name or frame.sensor}.npz")
        return None if found is None or "in_roi" not in found else found["in_roi"].astype(bool)

    def geometry(self, view: int) -> dict[str, np.ndarray] | None:
        """(H, W, ...) at the pose of the RGB frame: depth_z, normal, in_roi, ..."""
        return self.arrays("geometry", f"{view:04d}.npz")

    def labels(self) -> dict[str, str]:
        """Names of the labels in ``geometry``, by number."""
        path = self.folder / "labels.json"
        found = read_json(path) if path.is_file() else {}
        if not isinstance(found, dict) or not all(key.isdecimal() and isinstance(name, str) for key, name in found.items()):
            raise InputError(f"{path}: expected an object of label numbers and their names.")
        return found

    def aligned(self, view: int) -> dict[str, np.ndarray]:
        """Light (H, W, C) of all modalities at the pose of the RGB frame, by canonical modality name."""
        found = self.arrays("aligned", f"{view:04d}.npz") or {}
        return {canonical_modality(key): value.astype(np.float32) for key, value in found.items() if value.ndim == 3}
