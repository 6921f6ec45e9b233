"""Sensor to sensor, as files: what another sensor of the field would have seen at given frames (see ``conversion``)."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import write_json
from mmsynth.operations import previews
from mmsynth.operations.conversion import Converted, chosen_method, convert_frame
from mmsynth.operations.progress import Counter, Progress
from mmsynth.operations.register import landmarks, register
from mmsynth.operations.trajectories import View
from mmsynth.scene.images import load_frame, write_npz, write_png16
from mmsynth.scene.scene import Frame, Scene, Sensor, canonical_modality
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.mosaic import photosites_of

if TYPE_CHECKING:
    from mmsynth.field.field import Field


def wavelengths_array(sensor: Sensor) -> np.ndarray:
    """(C,) float32 nm, NaN where a channel is broad or unknown."""
    return np.array([np.nan if w is None else w for w in sensor.wavelengths_nm], np.float32)


def camera_json(camera: Camera, camera_to_world: np.ndarray) -> dict[str, Any]:
    """Intrinsics, lens and pose in the library's conventions, ready for JSON."""
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "lens": camera.lens,
        "distortion": list(camera.distortion),
        "camera_to_world": np.asarray(camera_to_world, dtype=np.float64).tolist(),
    }


def sensor_json(sensor: Sensor) -> dict[str, Any]:
    """Channel names, wavelengths and analyser angles of a sensor, ready for JSON."""
    return {
        "channels": list(sensor.channels),
        "wavelengths_nm": list(sensor.wavelengths_nm),
        "polarizer_angles_deg": None if sensor.polarizer_angles_deg is None else list(sensor.polarizer_angles_deg),
    }


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def modality_arrays(sensor: Sensor, values: np.ndarray, stokes: np.ndarray | None) -> dict[str, np.ndarray]:
    """What a file of one modality holds: data (H, W, C), channels, wavelengths_nm (NaN = none) and, for polarization, stokes (H, W, 3)."""
    arrays = {
        "data": values.astype(np.float32),
        "channels": np.array(sensor.channels, dtype=np.str_),
        "wavelengths_nm": wavelengths_array(sensor),
    }
    if stokes is not None:
        arrays["stokes"] = stokes.astype(np.float32)
        arrays["polarizer_angles_deg"] = np.array(sensor.polarizer_angles_deg, np.float32)
    return arrays


def source_views(field: Field, scene: Scene, source: str, views: Sequence[int] | None = None) -> list[View]:
    """Camera, pose (as the fit corrected it) and name (view id, 4 digits) of all frames of a sensor, or of some views.

    Raises:
        InputError: unknown sensor or view id.
    """
    source = canonical_modality(source)
    if source not in scene.sensors:
        raise InputError(f"modality {source!r}: not in the scene {scene.root}, expected one of {', '.join(scene.sensors)}.")
    frames = scene.frames_of(source)
    if views is not None:
        known = {frame.view for frame in frames}
        missing = sorted(set(views) - known)
        if missing:
            raise InputError(f"view {missing[0]}: the scene has no frame of '{source}' with this id, expected some of {_ranges(known)}.")
        frames = tuple(frame for frame in frames if frame.view in set(views))
    return [(frame.camera, field.pose_of(frame), f"{frame.view:04d}") for frame in frames]


def _ranges(ids: set[int]) -> str:
    """{0, 1, 2, 5} → "0-2, 5"."""
    runs: list[list[int]] = []
    for i in sorted(ids):
        if runs and i == runs[-1][1] + 1:
            runs[-1][1] = i
        else:
            runs.append([i, i])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def convert(
    field: Field,
    scene: Scene,
    source: str,
    target: str,
    out: Path | str,
    views: Sequence[int] | None = None,
    method: str = "auto",
    as_sensor: bool = False,
    progress: Progress | None = None,
) -> list[Path]:
    """What modality ``target`` would have seen at every ``source`` frame: on the frame's own pixels (intrinsics and lens included), aligned
    by construction, or as the target sensor itself would have seen it, from its place on the rig.

    Per view, in ``<out>/<target>/``:

    * ``NAME.npz``: data (H, W, C) float32, opacity, valid, confidence, guided, channels, wavelengths_nm; polarization also stokes (H, W, 3)
      in this camera's x-axis frame; with ``as_sensor`` and a mosaic also raw (H, W), what its photosites measure;
    * ``NAME.png``: 16-bit preview, tone-mapped with one exposure for all views; for polarization S0, and ``NAME_dolp.png`` (grey)
      and ``NAME_aolp.png`` (hue = AoLP, value = DoLP, see ``previews.preview_aolp``); ``NAME_confidence.png``;
    * ``NAME.json``: camera, method, exposure, conventions, hash; written last, so a view with a sidecar is complete.

    Args:
        views: view ids; None: all frames of the source. method: see ``conversion``. progress: called with (rays done, rays in all).
    Returns:
        the files written, the sidecars included.
    Raises:
        InputError: unknown modality, view or method, an unreadable frame, a target without a place on the rig, or the disk refused.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    # known before anything is rendered or written
    field.check_modalities([target])
    chosen = source_views(field, scene, source, views)
    field.check_modalities([source])
    if not chosen:
        raise InputError(f"convert to {target}: no views, expected at least one frame.")
    frames = [f for f in scene.frames_of(source) if views is None or f.view in set(views)]
    places = [_place(field, scene, source, target, frame) if as_sensor else None for frame in frames]
    items = [
        _Item(frame.path.name, name, camera, pose, place, functools.partial(_pixels, scene.sensors[source], frame), {})
        for frame, (camera, pose, name), place in zip(frames, chosen, places, strict=True)
    ]
    return _convert_each(field, source, target, items, Path(out), method, progress)


def convert_images(
    field: Field,
    scene: Scene,
    source: str,
    target: str,
    images: Sequence[Path],
    out: Path | str,
    method: str = "auto",
    progress: Progress | None = None,
) -> list[Path]:
    """``convert`` of frames without a pose, on their own pixels: each is registered against the field first (see ``register``).

    Args:
        images: files of the source sensor, with its size, lens and mosaic. Their names become those of the results.
    Raises:
        InputError: as ``convert``; a file of another size; a frame that cannot be registered, and why. Nothing is written then.
    """
    source, target = canonical_modality(source), canonical_modality(target)
    field.check_modalities([source, target])
    if not images:
        raise InputError(f"convert to {target}: no images, expected at least one file.")
    if len({path.stem for path in images}) < len(images):
        raise InputError("convert: two images have one name, expected names that differ.")
    camera = field.cameras[source]
    known = landmarks(field, scene, source)
    items = []
    for path in images:
        frame = Frame(source, 0, path, camera, np.eye(4))
        raw = _pixels(field.sensors[source], frame)
        found = register(field, known, raw, camera, source, str(path))
        facts = {"covariance": found.covariance.tolist(), "sd_px": found.sd_px, "inliers": found.inliers, "residual": found.residual}
        items.append(_Item(path.name, path.stem, camera, found.pose, None, functools.partial(_pixels, field.sensors[source], frame), facts))
    return _convert_each(field, source, target, items, Path(out), method, progress)


def _pixels(sensor: Sensor, frame: Frame) -> np.ndarray:
    return load_frame(sensor, frame)[0]


@dataclass(frozen=True)
class _Item:
    """A frame to convert: its file, the name of the results, camera and pose, those of the target if they are others, registration."""

    file: str
    name: str
    camera: Camera
    pose: np.ndarray
    seen_by: tuple[Camera, np.ndarray] | None
    read: Callable[[], np.ndarray]
    registration: dict[str, Any]


def _convert_each(
    field: Field, source: str, target: str, items: Sequence[_Item], out: Path, method: str, progress: Progress | None
) -> list[Path]:
    sensor, folder = field.sensors[target], out / target
    used = chosen_method(method, field.sensors[source], sensor)
    rays = [sum(c.width * c.height for c in (i.camera, *(() if i.seen_by is None else (i.seen_by[0],)))) for i in items]
    count = Counter(progress, sum(rays))
    written: list[Path] = []
    exposure: float | None = None
    for item, cost in zip(items, rays, strict=True):
        goal = count.done + cost
        found = convert_frame(field, item.read(), item.camera, item.pose, source, target, used, item.seen_by, progress=count)
        count(goal - count.done)
        sidecar = folder / f"{item.name}.json"
        # a stale sidecar must not vouch for new files if this run is cut off
        sidecar.unlink(missing_ok=True)
        data = folder / f"{item.name}.npz"
        write_npz(data, _arrays(sensor, found, item.seen_by is not None))
        linear = previews.preview_linear(sensor, found.values)
        exposure = previews.exposure_of(linear) if exposure is None else exposure
        pictures = {
            folder / f"{item.name}.png": previews.tone_map(linear, exposure),
            folder / f"{item.name}_confidence.png": found.confidence,
        }
        if found.stokes is not None:
            pictures[folder / f"{item.name}_dolp.png"] = previews.preview_dolp(found.stokes)
            pictures[folder / f"{item.name}_aolp.png"] = previews.preview_aolp(found.stokes)
        for path, picture in pictures.items():
            write_png16(path, picture)
        facts = {
            "name": item.name,
            "frame": item.file,
            "modality": target,
            "from": source,
            "method": found.method,
            "frame_exposure": found.exposure,
            "guided": float(found.guided.mean()),
            "registration": item.registration or None,
            "sensor": sensor_json(sensor),
            "camera": camera_json(*(item.seen_by or (item.camera, item.pose))),
            "conventions": CONVENTIONS,
            "unit": field.unit,
            "preview_exposure": exposure,
            "data": {"file": data.name, "sha256": sha256_of(data)},
        }
        write_json(sidecar, facts)
        written += [data, *pictures, sidecar]
    return written


def _place(field: Field, scene: Scene, source: str, target: str, frame: Frame) -> tuple[Camera, np.ndarray]:
    """Camera and pose of the target sensor at a frame of the source: its own frame of that view, else its place on the rig."""
    own = [f for f in scene.frames_of(target) if f.view == frame.view] if target in scene.sensors else []
    if own:
        return own[0].camera, field.pose_of(own[0])
    if target not in field.cameras or source not in field.rig or target not in field.rig:
        raise InputError(f"convert: {target!r} has no known place on the rig of {source!r}, expected a frame of it in view {frame.view}.")
    return field.cameras[target], field.pose_of(frame) @ np.linalg.inv(field.rig[source]) @ field.rig[target]


def _arrays(sensor: Sensor, found: Converted, as_sensor: bool) -> dict[str, np.ndarray]:
    arrays = modality_arrays(sensor, found.values, found.stokes)
    arrays |= {"opacity": found.opacity, "valid": found.valid, "confidence": found.confidence, "guided": found.guided}
    if as_sensor and sensor.mosaic is not None:
        arrays["raw"] = photosites_of(found.values, sensor.mosaic)
    return arrays


CONVENTIONS = {
    "camera_axes": "OpenCV: x right, y down, z forward; camera_to_world 4x4",
    "pixels": "centre of the top-left pixel is (0, 0)",
    "distortion": "OpenCV's: lens brown_conrady k1 k2 p1 p2 k3 k4 k5 k6, kannala_brandt (fisheye) k1 k2 k3 k4, undistorted to distorted; "
    "images are distorted, as the lens sees",
    "radiance": "linear float32, 1.0 = full scale of the sensor; NaN where the lens has no ray",
    "polarization": "S0 S1 S2 about the camera x axis; angles from image right towards image up; I = (S0 + S1 cos 2a + S2 sin 2a) / 2",
    "depth": "depth_z along the optical axis, depth_ray along the ray; NaN = no hit",
    "normal": "world frame, unit, outward; NaN = no hit",
    "world": "the scene's own frame and unit",
}
