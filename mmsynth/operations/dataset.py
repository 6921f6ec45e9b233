"""An aligned multimodal dataset from any poses: every modality, depth, normals, opacity and mask, with all that a reader must know.

Layout of ``<out>``::

    dataset.json             conventions, sensors, unit, field hash, versions; per file sha256, bytes, arrays (shape, dtype)
    transforms.json          the views as nerfstudio reads them (OpenGL axes, pixel centres at +0.5), images = views/NNNN/image.png
    views/NNNN/
        rgb.npz ms.npz ...   one file per modality, or .exr, or .tiff (16-bit, clipped to [0, 1]; Stokes as float TIFF)
        geometry.npz         depth_z, depth_ray, normal, opacity, mask (opacity > 0.5), valid
        image.png            16-bit linear picture of the first modality (for transforms.json and for looking)
        view.json            camera and pose per modality, the files and their hashes; written last: the view is complete

On the native rig every modality has a grid of its own: ``geometry_NAME``, ``image_NAME`` and ``transforms_NAME.json`` instead.
A run that is interrupted goes on where it was: a view whose ``view.json`` belongs to the same request and whose files have the
stated hashes is not rendered again. The same field and request give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tifffile

import mmsynth
from mmsynth.errors import InputError
from mmsynth.files import read_json, write_atomic, write_json
from mmsynth.operations.convert import CONVENTIONS, camera_json, modality_arrays, sensor_json, sha256_of
from mmsynth.operations.previews import preview_linear
from mmsynth.operations.progress import Counter, Progress
from mmsynth.operations.trajectories import View
from mmsynth.scene.images import write_exr, write_npz, write_png16, write_tiff16
from mmsynth.scene.poses import OPENGL_TO_OPENCV
from mmsynth.scene.scene import Sensor, canonical_modality
from mmsynth.sensors.camera import Camera

if TYPE_CHECKING:
    from mmsynth.field.field import Field, Rendering

RIGS = ("aligned", "native")
FORMATS = ("npz", "exr", "tiff")
LAYOUT = 1


def field_hash(field: Field) -> str:
    """SHA-256 over the parameters and the rendering settings: two fields with one hash render the same."""
    digest = hashlib.sha256(repr(getattr(field, "sampling", None)).encode())
    for name, tensor in sorted(field.state_dict().items()):
        value = tensor.detach().cpu().contiguous().numpy()
        digest.update(f"{name} {value.dtype} {value.shape}".encode())
        digest.update(value.tobytes())
    return digest.hexdigest()


def generate_dataset(
    field: Field,
    views: Sequence[View],
    out: Path | str,
    modalities: Sequence[str] | None = None,
    rig: str = "aligned",
    format: str = "npz",
    progress: Progress | None = None,
) -> Path:
    """Render all modalities at all views and write them as a dataset (layout: module docstring).

    Args:
        views: (camera, camera_to_world, name); ``trajectories.load_views`` makes them.
        modalities: names or aliases; None: all of the field.
        rig: "aligned": every modality on the view's own pixel grid; "native": the view is the reference sensor's and every other
            modality is seen by its own camera from its own place on the rig.
        format: "npz", "exr" (named float channels) or "tiff" (16-bit images, float geometry).
        progress: called with (rays done, rays in all); finished views count at once.
    Returns:
        the path of ``dataset.json``.
    Raises:
        InputError: no views, unknown modality, rig or format, a modality without a place on the rig, or the disk refused.
    """
    out = Path(out)
    if rig not in RIGS:
        raise InputError(f"dataset: rig is {rig!r}, expected one of {', '.join(RIGS)}.")
    if format not in FORMATS:
        raise InputError(f"dataset: format is {format!r}, expected one of {', '.join(FORMATS)}.")
    if not views:
        raise InputError("dataset: no views, expected at least one.")
    names = field.check_modalities(None if modalities is None else [canonical_modality(m) for m in modalities])
    if not names:
        raise InputError("dataset: no modalities, expected at least one.")
    placed = [_place(field, names, camera, pose, rig) for camera, pose, _ in views]
    request = {
        "layout": LAYOUT,
        "field": field_hash(field),
        "rig": rig,
        "format": format,
        "modalities": {name: sensor_json(field.sensors[name]) for name in names},
        "unit": field.unit,
        "conventions": CONVENTIONS,
        "versions": {"mmsynth": mmsynth.__version__} | {package: version(package) for package in ("numpy", "torch")},
    }
    groups = _groups(names, rig)
    per_view = [sum(cameras[group[0]][0].width * cameras[group[0]][0].height for group in groups) for cameras in placed]
    count = Counter(progress, sum(per_view))
    listing = []
    for index, ((_, _, name), cameras, rays) in enumerate(zip(views, placed, per_view, strict=True)):
        folder = out / "views" / f"{index:04d}"
        goal = count.done + rays
        stated = {"name": name, "cameras": {m: camera_json(c, p) for m, (c, p) in cameras.items()}}
        key = hashlib.sha256(json.dumps([request, stated], sort_keys=True).encode()).hexdigest()
        files = _finished(folder, key)
        if files is None:
            files = _render_view(field, cameras, rig, folder, format, count)
            write_json(folder / "view.json", {"request": key, **stated, "files": files})
        count(goal - count.done)
        listing.append({"folder": f"views/{index:04d}", **stated, "files": files})
    for group in groups:
        name = group[0]
        poses = [cameras[name] for cameras in placed]
        write_json(out / f"{_of('transforms', name, rig)}.json", _transforms(poses, f"{_of('image', name, rig)}.png"))
    write_json(out / "dataset.json", {**request, "views": listing})
    return out / "dataset.json"


Placed = dict[str, tuple[Camera, np.ndarray]]


def _place(field: Field, names: Sequence[str], camera: Camera, pose: np.ndarray, rig: str) -> Placed:
    """Camera and pose of each modality at one view."""
    if rig == "aligned":
        return dict.fromkeys(names, (camera, pose))
    reference = next(iter(field.sensors))
    out = {}
    for name in names:
        if name == reference:
            out[name] = (camera, pose)
        elif name in field.rig and name in field.cameras:
            out[name] = (field.cameras[name], pose @ field.rig[name])
        else:
            raise InputError(f"dataset: modality {name!r} has no known place on the rig of {reference!r}, expected --rig aligned.")
    return out


def _groups(names: Sequence[str], rig: str) -> list[list[str]]:
    """Modalities that share a pixel grid."""
    return [list(names)] if rig == "aligned" else [[name] for name in names]


def _render_view(field: Field, cameras: Placed, rig: str, folder: Path, format: str, count: Counter) -> dict[str, Any]:
    """Render one view and write its files; returns their listing. The sidecar goes first, so that it never vouches for new files."""
    (folder / "view.json").unlink(missing_ok=True)
    files: dict[str, Any] = {}
    for group in _groups(list(cameras), rig):
        camera, pose = cameras[group[0]]
        rendering = field.render(camera, pose, group, geometry=True, progress=count)
        for name in group:
            files |= _write_modality(folder, field.sensors[name], rendering, format)
        files |= _write(folder, _of("geometry", group[0], rig), _geometry_arrays(rendering), format)
        picture = folder / f"{_of('image', group[0], rig)}.png"
        write_png16(picture, preview_linear(field.sensors[group[0]], rendering.channels[group[0]]))
        files[picture.name] = _entry(picture, {"image": (camera.height, camera.width, 3)}, "uint16")
    return files


def _of(stem: str, modality: str, rig: str) -> str:
    """File stem: on the native rig, one per modality."""
    return stem if rig == "aligned" else f"{stem}_{modality}"


def _geometry_arrays(rendering: Rendering) -> dict[str, np.ndarray]:
    return {
        "depth_z": rendering.depth_z,
        "depth_ray": rendering.depth_ray,
        "normal": rendering.normal,
        "opacity": rendering.opacity,
        "mask": rendering.opacity > 0.5,
        "valid": rendering.valid,
    }


def _entry(path: Path, shapes: Mapping[str, tuple[int, ...]], dtype: str | Mapping[str, str]) -> dict[str, Any]:
    arrays = {k: {"shape": list(s), "dtype": dtype if isinstance(dtype, str) else dtype[k]} for k, s in shapes.items()}
    return {"sha256": sha256_of(path), "bytes": path.stat().st_size, "arrays": arrays}


def _write(folder: Path, stem: str, arrays: Mapping[str, np.ndarray], format: str) -> dict[str, Any]:
    """Write named (H, W) or (H, W, K) arrays; images as float channels in EXR, as one float file each in TIFF."""
    if format == "npz":
        path = folder / f"{stem}.npz"
        write_npz(path, arrays)
        return {path.name: _entry(path, {k: a.shape for k, a in arrays.items()}, {k: str(a.dtype) for k, a in arrays.items()})}
    if format == "exr":
        path = folder / f"{stem}.exr"
        channels = _exr_channels(arrays)
        write_exr(path, channels)
        return {path.name: _entry(path, {k: a.shape for k, a in channels.items()}, "float32")}
    out: dict[str, Any] = {}
    for key, array in arrays.items():
        path = folder / f"{stem}_{key}.tiff"
        _write_tiff_float(path, array)
        out[path.name] = _entry(path, {key: array.shape}, "float32")
    return out


def _write_modality(folder: Path, sensor: Sensor, rendering: Rendering, format: str) -> dict[str, Any]:
    arrays = modality_arrays(sensor, rendering.channels[sensor.name], rendering.stokes.get(sensor.name))
    if format == "npz":
        return _write(folder, sensor.name, arrays, format)
    image, stokes = arrays["data"], arrays.get("stokes")
    if format == "exr":
        channels = {label: image[..., i] for i, label in enumerate(_labels(sensor))}
        return _write(folder, sensor.name, channels | ({} if stokes is None else {"S": stokes}), format)
    path = folder / f"{sensor.name}.tiff"
    image = image[..., 0] if image.shape[2] == 1 else image
    write_tiff16(path, image)
    out = {path.name: _entry(path, {"data": image.shape}, "uint16")}
    return out if stokes is None else out | _write(folder, sensor.name, {"stokes": stokes}, format)


def _labels(sensor: Sensor) -> list[str]:
    """Channel names that are unique and that EXR accepts; a dot would open a layer."""
    labels = [c.replace(".", "_") or f"channel{i}" for i, c in enumerate(sensor.channels)]
    return labels if len(set(labels)) == len(labels) else [f"{i}_{label}" for i, label in enumerate(labels)]


_COMPONENTS = {"normal": ("X", "Y", "Z"), "S": ("0", "1", "2")}


def _exr_channels(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """normal (H, W, 3) → normal.X normal.Y normal.Z; S (H, W, 3) → S.0 S.1 S.2; (H, W) keep their name."""
    out = {}
    for key, array in arrays.items():
        if array.ndim == 2:
            out[key] = array
        else:
            out |= {f"{key}.{part}": array[..., i] for i, part in enumerate(_COMPONENTS[key])}
    return out


def _write_tiff_float(path: Path, image: np.ndarray) -> None:
    pixels = np.ascontiguousarray(image, np.float32)
    planar = "contig" if pixels.ndim == 3 else None
    write_atomic(
        path,
        lambda temporary: tifffile.imwrite(
            temporary, pixels, photometric="minisblack", planarconfig=planar, compression="zlib", metadata=None
        ),
    )


def _transforms(cameras: Sequence[tuple[Camera, np.ndarray]], picture: str) -> dict[str, Any]:
    """nerfstudio's transforms.json: OpenGL axes, centre of the top-left pixel at (0.5, 0.5)."""
    frames = []
    for index, (camera, pose) in enumerate(cameras):
        fisheye = camera.lens == "kannala_brandt"
        names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        frames.append({
            "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
            "file_path": f"views/{index:04d}/{picture}",
            "w": camera.width,
            "h": camera.height,
            "fl_x": camera.fx,
            "fl_y": camera.fy,
            "cx": camera.cx + 0.5,
            "cy": camera.cy + 0.5,
            **dict(zip(names, map(float, camera.coefficients), strict=True)),
            "transform_matrix": (np.asarray(pose) @ OPENGL_TO_OPENCV).tolist(),
        })  # fmt: skip
    return {"camera_model": frames[0]["camera_model"] if frames else "OPENCV", "frames": frames}


def _finished(folder: Path, key: str) -> dict[str, Any] | None:
    """The file listing of a complete view of the same request, or None."""
    try:
        sidecar = read_json(folder / "view.json")
    except InputError:
        return None
    if not isinstance(sidecar, dict) or sidecar.get("request") != key:
        return None
    files: dict[str, Any] = sidecar["files"]
    return files if not any(_file_problems(folder, files)) else None


def _file_problems(folder: Path, files: Mapping[str, Any]) -> list[str]:
    problems = []
    for name, stated in files.items():
        path = folder / name
        if not path.is_file():
            problems.append(f"{path}: missing.")
        elif path.stat().st_size != stated["bytes"]:
            problems.append(f"{path}: {path.stat().st_size} bytes, expected {stated['bytes']}.")
        elif sha256_of(path) != stated["sha256"]:
            problems.append(f"{path}: the content does not match its SHA-256 in dataset.json.")
    return problems


def verify(out: Path | str) -> list[str]:
    """Check a dataset against its ``dataset.json``: one sentence per problem, empty when all is well.

    Every file is there with the stated size and hash; npz files hold the stated arrays; no array of numbers is infinite.

    Raises:
        InputError: there is no readable ``dataset.json``.
    """
    out = Path(out)
    content = read_json(out / "dataset.json")
    if not isinstance(content, dict) or not isinstance(content.get("views"), list):
        raise InputError(f"{out / 'dataset.json'}: key 'views' is missing, expected a dataset made by generate-dataset.")
    problems: list[str] = []
    for view in content["views"]:
        folder = out / view["folder"]
        found = _file_problems(folder, view["files"])
        problems += found
        if not (folder / "view.json").is_file():
            problems.append(f"{folder / 'view.json'}: missing.")
        if not found:
            for name, stated in view["files"].items():
                if name.endswith(".npz"):
                    problems += _array_problems(folder / name, stated["arrays"])
    return problems


def _array_problems(path: Path, stated: Mapping[str, Any]) -> list[str]:
    problems = []
    with np.load(path) as arrays:
        for key, facts in stated.items():
            if key not in arrays:
                problems.append(f"{path}: array '{key}' is missing.")
                continue
            array = arrays[key]
            if list(array.shape) != facts["shape"] or str(array.dtype) != facts["dtype"]:
                problems.append(f"{path}: array '{key}' is {array.dtype}{list(array.shape)}, expected {facts['dtype']}{facts['shape']}.")
            elif array.dtype.kind == "f" and np.isinf(array).any():
                problems.append(f"{path}: array '{key}' holds infinite values.")
    return problems
