"""Frames, or a window of them around the region of interest."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import Frame, PosedCamera, Sensor
from mmsynth.sensors.camera import project

if TYPE_CHECKING:
    from mmsynth.field.field import Field

WINDOW = (160, 200)
"""Rows and columns at most that evidence is gathered from."""


def opened(field: Field, frame: Frame, window: tuple[int, int] | None = None) -> tuple[np.ndarray, PosedCamera]:
    """A frame's raw values, camera and pose; those of at most ``window`` rows and columns around the region's centre."""
    sensor, camera, pose = field.sensors[frame.sensor], frame.camera, field.pose_of(frame)
    raw = load_frame(sensor, frame)[0]
    if window is None:
        return raw, PosedCamera(camera, pose)
    rows, columns = around_region(field, PosedCamera(camera, pose), sensor, window)
    size = {"width": columns.stop - columns.start, "height": rows.stop - rows.start}
    part = replace(camera, cx=camera.cx - columns.start, cy=camera.cy - rows.start, **size)
    return raw[rows, columns], PosedCamera(part, pose)


def around_region(field: Field, view: PosedCamera, sensor: Sensor, window: tuple[int, int] = WINDOW) -> tuple[slice, slice]:
    """Rows and columns of a view, at most ``window`` of them, around the region's centre; a mosaic keeps its phase."""
    camera, pose = view.camera, view.camera_to_world
    centre = project(((np.asarray(field.region.centre) - pose[:3, 3]) @ pose[:3, :3])[None], camera)[0]
    spans = []
    for at, size, most, step in zip(
        centre[::-1], (camera.height, camera.width), window, (1, 1) if sensor.mosaic is None else sensor.mosaic.shape, strict=True
    ):
        middle = at if np.isfinite(at) else size / 2.0  # NaN: the camera does not see it
        first = int(np.clip(middle - most / 2.0, 0, max(size - most, 0))) // step * step
        spans.append(slice(first, min(size, first + most)))
    return spans[0], spans[1]
