"""A copy of a scene as other methods want it: every channel at every pixel, and no lens. What is lost by that is to be measured: a field
is fitted to raw frames here, never to these."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import write_atomic, write_text
from mmsynth.scene.image_writers import to_uint16, write_png, write_png16
from mmsynth.scene.images import load_frame
from mmsynth.scene.layouts.mmsdata import meta_content
from mmsynth.scene.masks import read_mask
from mmsynth.scene.scene import Frame, PosedCamera, Scene, Sensor
from mmsynth.sensors.camera import Camera, project
from mmsynth.sensors.mosaic import channels_of, demosaic_edge_aware, is_bayer

_LONGEST = 4.0  # times the focal length: a lens that bends more has no pinhole picture worth the name


def write_demosaicked(scene: Scene, out: Path) -> Path:
    """Write the copy in MMS-DATA's layout for demosaicked and undistorted frames; a copy that is there is kept.

    Bayer mosaics are demosaicked by OpenCV's edge-aware method, others by bilinear interpolation of each channel; then frames and masks
    are resampled as ``cv2.undistort`` does, bilinear, onto ``pinhole_of`` their camera, and stored in 16 bits (float frames as floats).
    Ground truth is not copied: it belongs to the frames' own pixels.

    Returns:
        ``out``. Its meta_data.json comes last: without it nothing was finished.
    Raises:
        InputError: a picture that cannot be read, a lens without a pinhole picture, or ``out`` cannot be written.
    """
    if (out / "meta_data.json").is_file():
        return out
    views: dict[str, dict[int, PosedCamera]] = {name: {} for name in scene.sensors}
    for frame in scene.frames:
        views[frame.sensor][frame.view] = _write_frame(scene.sensors[frame.sensor], frame, out)
    sensors = [replace(sensor, mosaic=None) for sensor in scene.sensors.values()]
    content = meta_content(scene.root, sensors, views, scene.region, scene.unit, own_cameras=True)
    content |= {"undistorted": True, "test_ids": list(scene.split.test)}
    write_text(out / "meta_data.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    return out


def is_plain(scene: Scene) -> bool:
    """Whether there is nothing to demosaic and nothing to undistort."""
    return not any(sensor.mosaic is not None for sensor in scene.sensors.values()) and all(_no_lens(f.camera) for f in scene.frames)


def pinhole_of(camera: Camera) -> Camera:
    """The camera without its lens: the same size and principal point, and the same focal lengths, as ``cv2.undistort`` has them, or such
    longer ones (by whole per cent) that every pixel shows what the lens saw, and none is black.

    Raises:
        InputError: not even four times as long.
    """
    u, v = np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    last = np.array([camera.width - 1, camera.height - 1])
    sides = [np.stack(np.broadcast_arrays(*side), -1) for side in ((u, 0.0), (u, last[1]), (0.0, v), (last[0], v))]
    border = np.concatenate(sides)
    for longer in np.arange(1.0, _LONGEST, 0.01):
        plain = replace(camera, fx=camera.fx * longer, fy=camera.fy * longer, distortion=(), lens="brown_conrady")
        seen = _source_pixels(border, plain, camera)
        if bool((np.isfinite(seen) & (seen >= -0.5) & (seen <= last + 0.5)).all()):
            return plain
    raise InputError(f"camera {camera.width}x{camera.height}: its lens bends too much to be undistorted onto a plane.")


def _source_pixels(pixels: np.ndarray, plain: Camera, camera: Camera) -> np.ndarray:
    """Pixels (..., 2) of the pinhole → those of the camera, NaN where it has none."""
    rays = (pixels - plain.intrinsics[2:]) / plain.intrinsics[:2]
    return project(np.concatenate([rays, np.ones_like(rays[..., :1])], -1), camera)


def _no_lens(camera: Camera) -> bool:
    return camera.lens == "brown_conrady" and not any(camera.distortion)


@functools.lru_cache(maxsize=8)
def _resampler(camera: Camera) -> tuple[Camera, Callable[[np.ndarray, int], np.ndarray]]:
    """The pinhole, and what takes a picture (H, W, C) of the camera to it, by OpenCV's method of interpolation."""
    if _no_lens(camera):
        return camera, lambda image, method: image
    plain = pinhole_of(camera)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    x, y = np.moveaxis(_source_pixels(np.stack([u, v], -1).astype(np.float64), plain, camera).astype(np.float32), -1, 0)

    def resample(image: np.ndarray, method: int) -> np.ndarray:
        # remap takes four channels at most
        planes = [np.ascontiguousarray(image[..., c]) for c in range(image.shape[2])]
        planes = [np.asarray(cv2.remap(plane, x, y, method, borderMode=cv2.BORDER_REPLICATE)) for plane in planes]
        return np.stack(planes, -1)

    return plain, resample


def _write_frame(sensor: Sensor, frame: Frame, out: Path) -> PosedCamera:
    """Write the frame and its mask; what was written, at its pose."""
    plain, resample = _resampler(frame.camera)
    image, alpha = load_frame(sensor, frame)
    floats = math.isinf(sensor.saturation)  # files of floats have no full scale
    if sensor.mosaic is not None and is_bayer(sensor.mosaic) and not floats:
        image = np.moveaxis(demosaic_edge_aware(image, sensor.mosaic), 0, -1)
    else:
        image = channels_of(image, sensor.mosaic)
    image = resample(image if alpha is None else np.concatenate([image, alpha[..., None]], -1), cv2.INTER_LINEAR)
    folder, stem = out / "modalities" / sensor.name, f"{frame.view:04d}"
    name = f"{stem}.png" if image.shape[2] in (1, 3) and not floats else f"{stem}.npy"
    if name.endswith(".png"):
        write_png16(folder / name, image)
    else:
        numbers = image if floats else to_uint16(image)
        write_atomic(folder / name, lambda temporary: np.save(temporary, numbers))
    mask = read_mask(frame)
    if mask is not None:
        # as MMS-DATA has them, see its reader
        seen = resample(mask[..., None].astype(np.uint8), cv2.INTER_NEAREST)
        write_png(out / "masks" / sensor.name / f"{stem}.png", seen * np.uint8(255))
    return PosedCamera(plain, frame.camera_to_world, name)
