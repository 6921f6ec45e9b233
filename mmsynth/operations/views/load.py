"""Where to look from: poses files, trajectories, the frames of a scene, and another sensor's place on the rig."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.operations.views.trajectories import trajectory_views
from mmsynth.scene.load import read_poses
from mmsynth.scene.scene import PosedCamera, Scene, canonical_modality
from mmsynth.sensors.camera import Camera

if TYPE_CHECKING:
    from mmsynth.field.field import Field

Rig = Literal["aligned", "native"]
"""aligned: all sensors look from the view itself; native: the view is the reference sensor's, the others have their places on the rig."""
RIGS: tuple[Rig, ...] = get_args(Rig)


def load_views(
    views: Sequence[PosedCamera] | Path | str, field: Field, scene: Scene | None = None, *, sensor: str | None = None
) -> Sequence[PosedCamera]:
    """Read a poses file or a trajectory (JSON with the key 'trajectory'); in the scene's world frame and unit.

    Poses without intrinsics, and trajectories, take the camera of ``sensor``; None: the reference camera of the field.

    Args:
        views: the file, sought as it is given, then in the scene's folder; views that are loaded already come back as they are.
        scene: needed for a trajectory, too: its training poses say what is up and how far away to be.
    Raises:
        InputError: unreadable file, unknown layout, or bad value.
    """
    if not isinstance(views, (Path, str)):
        return views
    path = Path(views)
    if scene is not None and not path.exists() and (scene.root / path).exists():
        path = scene.root / path
    own = None if sensor is None else field.cameras.get(sensor)
    if path.suffix.lower() == ".json":
        content = read_json(path)
        if isinstance(content, dict) and "trajectory" in content:
            training = training_poses(field, scene) if scene is not None else []
            return trajectory_views(content, field.region, own or reference_camera(field), training, str(path))
    poses = read_poses(path)
    return [PosedCamera(p.camera or own or reference_camera(field), p.camera_to_world, p.name) for p in poses]


def views_of_frames(field: Field, scene: Scene, sensor: str, ids: Sequence[int] | None = None) -> list[PosedCamera]:
    """Camera, pose (as the fit corrected it) and name (view id, 4 digits) of all frames of a sensor, or of those with some view ids.

    Raises:
        InputError: unknown sensor or view id.
    """
    sensor = canonical_modality(sensor)
    if sensor not in scene.sensors:
        raise InputError(f"modality {sensor!r}: not in the scene {scene.root}, expected one of {', '.join(scene.sensors)}.")
    frames = scene.frames_of(sensor)
    if ids is not None:
        known = {frame.view for frame in frames}
        missing = sorted(set(ids) - known)
        if missing:
            raise InputError(f"view {missing[0]}: the scene has no frame of '{sensor}' with this id, expected some of {_ranges(known)}.")
        frames = scene.frames_of(sensor, tuple(ids))
    return [PosedCamera(frame.camera, field.pose_of(frame), f"{frame.view:04d}") for frame in frames]


def on_the_rig(field: Field, view: PosedCamera, sensor: str, target: str) -> PosedCamera:
    """Camera and pose of the sensor ``target`` when ``sensor`` looks from a view.

    Raises:
        InputError: the field does not know where the two are on one rig.
    """
    if target not in field.cameras or sensor not in field.rig or target not in field.rig:
        raise InputError(f"{target!r} has no known place on the rig of {sensor!r}, expected frames of both in the scene.")
    pose = view.camera_to_world @ np.linalg.inv(field.rig[sensor]) @ field.rig[target]
    return PosedCamera(field.cameras[target], pose, view.name)


def reference_camera(field: Field) -> Camera:
    """Intrinsics of the field's first sensor that has any.

    Raises:
        InputError: the field stores no camera.
    """
    for name in field.sensors:
        if name in field.cameras:
            return field.cameras[name]
    raise InputError("field: it stores no camera, expected poses with intrinsics.")


def training_poses(field: Field, scene: Scene) -> list[np.ndarray]:
    """(4, 4) poses of the reference sensor's training views, in view order, as the fit corrected them."""
    for name in scene.sensors:
        frames = scene.frames_of(name, scene.split.train)
        if frames:
            return [field.pose_of(frame) for frame in frames]
    return []


def _ranges(ids: set[int]) -> str:
    """{0, 1, 2, 5} → "0-2, 5"."""
    runs: list[list[int]] = []
    for i in sorted(ids):
        if runs and i == runs[-1][1] + 1:
            runs[-1][1] = i
        else:
            runs.append([i, i])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)
