"""A generated dataset as tensors, for training; and a crop and flip that leave polarization right."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from mmsynth.errors import InputError
from mmsynth.operations.dataset.index import read_dataset
from mmsynth.operations.output.records import read_record
from mmsynth.scene.images import load_frame, read_npz
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Frame, PosedCamera, canonical_modality
from mmsynth.scene.serialisation import channels_to_json, posed_from_json, posed_to_json
from mmsynth.sensors.polarization import flip_stokes

Item = dict[str, Tensor]
_GEOMETRY = ("geometry", "flow")


class AlignedDataset(Dataset[Item]):
    """Views of a dataset, in any format that ``generate-dataset`` writes, or of an aligned scene in the layout of MMS-DATA or nerfstudio.

    An item holds, float32 and (K, H, W) where nothing else is said: every modality by its name (``rgb``, ``ms``, ...), ``NAME/stokes``;
    ``depth_z``, ``depth_ray`` [unit of the scene], ``normal``, ``normal_camera``, ``opacity``, ``coverage``, ``flow`` [px]; bool ``mask``,
    ``valid``, ``occluded``, ``saturated_NAME``; ``intrinsics`` (3, 3) and ``camera_to_world`` (4, 4), float64, of the first modality. On a
    native rig what belongs to a modality's own grid is called ``NAME/depth_z``, ``NAME/intrinsics``, ... NaN: no ray, no surface. What a
    view does not have (the flow of the last one) its item does not have.

    Args:
        path: the folder. modalities: names or aliases, None: all. geometry: whether depth, normals, flow and so on are read, too.
        transform: applied to every item.
    Raises:
        InputError: no dataset there, an unknown modality, or (on access) a missing or damaged file.
    """

    def __init__(
        self,
        path: Path | str,
        modalities: Sequence[str] | None = None,
        geometry: bool = True,
        transform: Callable[[Item], Item] | None = None,
    ) -> None:
        self.path, self.geometry, self.transform = Path(path), geometry, transform
        if (self.path / "dataset.json").is_file():
            self.content: dict[str, Any] = read_dataset(self.path)
            known = list(self.content["modalities"])
            self._members = {name: _members(self.path / name) for name in self.content.get("shards", {})}
        else:
            self.content, self._members = _content_of_scene(self.path), {}
            known = list(self.content["modalities"])
        self.modalities = known if modalities is None else [canonical_modality(name) for name in modalities]
        for name in self.modalities:
            if name not in known:
                raise InputError(f"{self.path}: no modality {name!r}, expected some of {', '.join(known)}.")

    @property
    def polarizer_angles_deg(self) -> dict[str, tuple[float, ...]]:
        """Of each polarization modality, in the order of its channels."""
        angles = {name: self.content["modalities"][name]["polarizer_angles_deg"] for name in self.modalities}
        return {name: tuple(given) for name, given in angles.items() if given is not None}

    def __len__(self) -> int:
        return len(self.content["views"])

    def __getitem__(self, index: int) -> Item:
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        view = self.content["views"][index]
        native = self.content.get("rig") == "native"
        item: Item = {}
        for name in self.modalities:
            for key, array in self._record(view, name).items():
                item[name if key == "data" else f"{name}/{key}"] = _as_tensor(array)
        grids: Sequence[str | None] = self.modalities if native else [None]
        for grid in grids:
            prefix = "" if grid is None else f"{grid}/"
            posed = posed_from_json(view["cameras"][grid or next(iter(view["cameras"]))])
            item[f"{prefix}intrinsics"] = torch.from_numpy(posed.camera.matrix)
            item[f"{prefix}camera_to_world"] = torch.from_numpy(posed.camera_to_world)
            for record in (r if grid is None else f"{r}_{grid}" for r in _GEOMETRY):
                if self.geometry and any(f["record"] == record for f in view["files"].values()):
                    item |= {f"{prefix}{key}": _as_tensor(array) for key, array in self._record(view, record).items()}
        return item if self.transform is None else self.transform(item)

    def _record(self, view: Mapping[str, Any], record: str) -> dict[str, np.ndarray]:
        if "frames" in view:
            pixels, _ = load_frame(view["sensors"][record], view["frames"][record])
            return {"data": pixels}
        if "shard" not in view:
            return read_record(self.path / view["folder"], view["files"], record)
        out: dict[str, np.ndarray] = {}
        for name, stated in view["files"].items():
            if stated["record"] == record:
                arrays = read_npz(self._bytes(view["shard"], f"{view['key']}.{name}"), f"{self.path / view['shard']}: {name}")
                out |= {key: arrays[key] for key in stated["arrays"]}
        return out

    def _bytes(self, shard: str, member: str) -> io.BytesIO:
        start, length = self._members[shard][member]
        with open(self.path / shard, "rb") as stream:
            stream.seek(start)
            return io.BytesIO(stream.read(length))


def crop_and_flip(
    item: Item, size: tuple[int, int], generator: torch.Generator, polarizer_angles_deg: Mapping[str, Sequence[float]]
) -> Item:
    """A random crop, mirrored left to right half of the time, of an item of an aligned dataset.

    Mirroring turns the sign of every angle: S2, and which analyser is which. The camera's axes are mirrored with it (``normal_camera``,
    ``flow``, the principal point); the world is not, so world normals and poses are left out.

    Args:
        size: height, width [px]. polarizer_angles_deg: of each polarization modality, in the order of its channels
            (``AlignedDataset.polarizer_angles_deg``).
    Raises:
        InputError: the images are smaller than the crop, or the mirrored analysers are not among the given ones.
    """
    images = {key: image for key, image in item.items() if key.split("/")[-1] not in ("normal", "camera_to_world", "intrinsics")}
    height, width = next(iter(images.values())).shape[-2:]
    if height < size[0] or width < size[1]:
        raise InputError(f"crop: {size[1]}x{size[0]} pixels of {width}x{height}, expected no more than there are.")
    top, left = (int(torch.randint(high, (), generator=generator)) for high in (height - size[0] + 1, width - size[1] + 1))
    flip = bool(torch.rand((), generator=generator) < 0.5)
    out = {}
    for key, image in images.items():
        part = image[..., top : top + size[0], left : left + size[1]]
        out[key] = _mirrored(key, part.flip(-1), polarizer_angles_deg) if flip else part
    for key, matrix in item.items():
        if key.endswith("intrinsics"):
            moved = matrix.clone()
            moved[0, 2] = size[1] - 1 - (matrix[0, 2] - left) if flip else matrix[0, 2] - left
            moved[1, 2] -= top
            out[key] = moved
    return out


def _mirrored(key: str, image: Tensor, angles: Mapping[str, Sequence[float]]) -> Tensor:
    """Values of a picture whose pixels were mirrored already, (K, H, W)."""
    kind = key.split("/")[-1]
    if kind == "stokes":
        return flip_stokes(image.movedim(0, -1)).movedim(-1, 0)
    if kind in ("normal_camera", "flow"):
        return image * image.new_tensor([-1.0] + [1.0] * (len(image) - 1))[:, None, None]
    if key in angles:
        turned = [(-angle) % 180.0 for angle in angles[key]]
        if any(angle % 180.0 not in turned for angle in angles[key]):
            raise InputError(f"flip: the analysers of '{key}' at {', '.join(f'{a:g}' for a in angles[key])} deg have no mirror images.")
        return image[[turned.index(angle % 180.0) for angle in angles[key]]]
    return image


def _as_tensor(array: np.ndarray) -> Tensor:
    """(H, W) or (H, W, K) → (1 or K, H, W)."""
    return torch.from_numpy(np.ascontiguousarray(array[None] if array.ndim == 2 else np.moveaxis(array, -1, 0)))


def _members(shard: Path) -> dict[str, tuple[int, int]]:
    """Where in a tar file the content of each member is: first byte, length."""
    try:
        with tarfile.open(shard) as tar:
            return {member.name: (member.offset_data, member.size) for member in tar.getmembers()}
    except (OSError, tarfile.TarError) as error:
        raise InputError(f"{shard}: missing or damaged shard, could not be read ({error}).") from error


def _content_of_scene(path: Path) -> dict[str, Any]:
    """As much of ``dataset.json`` as a scene has whose modalities share their pixels."""
    scene = load_scene(path)
    views: dict[int, dict[str, Frame]] = {}
    for frame in scene.frames:
        views.setdefault(frame.view, {})[frame.sensor] = frame
    listed = []
    for view, frames in views.items():
        first = next(iter(frames.values()))
        for name, frame in frames.items():
            same = frame.camera == first.camera and np.allclose(frame.camera_to_world, first.camera_to_world, rtol=0, atol=1e-9)
            if len(frames) < len(scene.sensors) or not same or scene.sensors[name].mosaic is not None:
                raise InputError(f"{frame.path}: not aligned with the other modalities of view {view}, expected one pixel grid, no mosaic.")
        cameras = {name: posed_to_json(PosedCamera(frame.camera, frame.camera_to_world)) for name, frame in frames.items()}
        listed.append({"name": f"{view:04d}", "cameras": cameras, "files": {}, "frames": frames, "sensors": scene.sensors})
    return {"modalities": {name: channels_to_json(sensor) for name, sensor in scene.sensors.items()}, "views": listed}
