"""Cameras, sensors and the library's conventions as JSON, in manifests and sidecars, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from mmsynth.scene.scene import PosedCamera, Scene, SceneSource, Sensor
from mmsynth.sensors.camera import Camera

CONVENTIONS = {
    "camera_axes": "OpenCV: x right, y down, z forward; camera_to_world 4x4",
    "pixels": "centre of the top-left pixel is (0, 0)",
    "distortion": "OpenCV's: lens brown_conrady k1 k2 p1 p2 k3 k4 k5 k6, kannala_brandt (fisheye) k1 k2 k3 k4, undistorted to distorted; "
    "images are distorted, as the lens sees",
    "radiance": "linear float32, 1.0 = full scale of the sensor; NaN where the lens has no ray",
    "polarization": "S0 S1 S2 about the camera x axis; angles from image right towards image up; I = (S0 + S1 cos 2a + S2 sin 2a) / 2",
    "depth": "depth_z along the optical axis, depth_ray along the ray; NaN = no hit",
    "normal": "world frame, unit, outward; normal_camera the same in the camera's axes; NaN = no hit",
    "world": "the scene's own frame and unit",
}


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Intrinsics [px] and lens."""
    return asdict(camera) | {"distortion": list(camera.distortion)}


def camera_from_json(stated: Mapping[str, Any]) -> Camera:
    """What ``camera_to_json`` wrote; keys beside its own are passed over."""
    return Camera(**{f.name: stated[f.name] for f in fields(Camera)} | {"distortion": tuple(stated["distortion"])})


def posed_to_json(posed: PosedCamera) -> dict[str, Any]:
    """Intrinsics, lens and pose (4, 4) of a camera; its name is not in it."""
    return camera_to_json(posed.camera) | {"camera_to_world": np.asarray(posed.camera_to_world, dtype=np.float64).tolist()}


def posed_from_json(stated: Mapping[str, Any]) -> PosedCamera:
    """What ``posed_to_json`` wrote, without a name."""
    return PosedCamera(camera_from_json(stated), np.array(stated["camera_to_world"], dtype=np.float64))


def source_to_json(scene: Scene) -> dict[str, Any]:
    """Where a scene is and how it was read, for ``load.load_again``."""
    source = scene.source or SceneSource(scene.root)
    stated: dict[str, Any] = {"path": str(source.path.resolve()), "format": scene.format, "masks": scene.masks}
    if scene.mask_folder is not None:
        stated["mask_folder"] = str(scene.mask_folder.resolve())
    if source.images is not None:
        stated["images"] = str(source.images)
    if source.also:
        stated["also"] = dict(source.also)
    return stated


def channels_to_json(sensor: Sensor) -> dict[str, Any]:
    """Names, wavelengths and analyser angles of a sensor's channels."""
    return {
        "channels": list(sensor.channels),
        "wavelengths_nm": list(sensor.wavelengths_nm),
        "polarizer_angles_deg": None if sensor.polarizer_angles_deg is None else list(sensor.polarizer_angles_deg),
    }


def sensor_to_json(sensor: Sensor) -> dict[str, Any]:
    """All of a sensor."""
    return {
        "name": sensor.name,
        **channels_to_json(sensor),
        "mosaic": None if sensor.mosaic is None else sensor.mosaic.tolist(),
        "saturation": sensor.saturation if math.isfinite(sensor.saturation) else None,  # float images never clip; JSON has no inf
    }


def what_scenes_add(scene: Scene) -> dict[str, Any]:
    """What no layout for photographs holds: ``modalities`` (keys of ``known_sensors.make_sensor``), ``unit`` and ``region``."""
    described = {
        name: {key: value for key, value in channels_to_json(sensor).items() if value is not None}
        | ({} if sensor.mosaic is None else {"mosaick_pattern": sensor.mosaic.tolist()})
        for name, sensor in scene.sensors.items()
    }
    region = {"centre": list(scene.region.centre), "radius": scene.region.radius}
    return {"modalities": described, "unit": scene.unit, "region": region}


def sensor_from_json(stated: Mapping[str, Any]) -> Sensor:
    """What ``sensor_to_json`` wrote."""
    angles = stated["polarizer_angles_deg"]
    return Sensor(
        name=stated["name"],
        channels=tuple(stated["channels"]),
        wavelengths_nm=tuple(stated["wavelengths_nm"]),
        mosaic=None if stated["mosaic"] is None else np.array(stated["mosaic"]),
        polarizer_angles_deg=None if angles is None else tuple(angles),
        saturation=math.inf if stated["saturation"] is None else stated["saturation"],
    )
