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

import mmsynth
from mmsynth.errors import InputError
from mmsynth.files import read_json, sha256_of, write_json
from mmsynth.operations.previews import preview_linear
from mmsynth.operations.progress import Counter, Progress
from mmsynth.operations.records import CONVENTIONS, FORMATS, UNITS, camera_json, field_hash, modality_arrays, sensor_json, write_record
from mmsynth.operations.trajectories import View
from mmsynth.scene.images import write_png16
from mmsynth.scene.poses import OPENGL_TO_OPENCV
from mmsynth.scene.scene import canonical_modality
from mmsynth.sensors.camera import Camera

if TYPE_CHECKING:
    from mmsynth.field.field import Field, Rendering

RIGS = ("aligned", "native")
LAYOUT = 2


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
            arrays = modality_arrays(rendering.channels[name], rendering.stokes.get(name))
            files |= write_record(folder, name, arrays, format, UNITS, field.sensors[name])
        units = UNITS | {"depth_z": field.unit, "depth_ray": field.unit}
        files |= write_record(folder, _of("geometry", group[0], rig), _geometry_arrays(rendering), format, units)
        picture = folder / f"{_of('image', group[0], rig)}.png"
        write_png16(picture, preview_linear(field.sensors[group[0]], rendering.channels[group[0]]))
        shown = {"shape": [camera.height, camera.width, 3], "dtype": "uint16", "unit": "full scale"}
        facts = {"sha256": sha256_of(picture), "bytes": picture.stat().st_size, "arrays": {"image": shown}}
        files[picture.name] = {"record": picture.stem, **facts}
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
