"""What was measured: sensors, frames and their poses, as plain frozen dataclasses.

Conventions (every reader converts to these, every writer from these):

* Camera axes are OpenCV's: x right, y down, z forward. ``camera_to_world`` is 4x4 float64 and rigid.
* The centre of the top-left pixel is (0, 0).
* The world frame is the input's own, in metres where the input says so (``Scene.unit``).
* Pixel values are linear radiance, 1.0 = the sensor's full scale.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from mmsynth.errors import InputError
from mmsynth.sensors.camera import Camera

Layout = Literal["MMS-DATA", "nerfstudio", "Blender", "COLMAP", "NeuS", "Middlebury"]
MaskMeaning = Literal["object", "ignore", "off"]
"""What masks say of the pixels outside: nothing is there (opacity 0, and 1 inside); not to be learned from; nothing, they only score."""

MAX_VIEW = 999_999_999  # ids of views are whole numbers from 0
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""camera_to_world in OpenGL axes (y up, z back) times this = in OpenCV axes."""

ALIASES = {
    "infrared": "nir", "polarization": "pol", "polarisation": "pol", "multispectral": "ms",
    "monochrome": "mono", "gray": "mono", "grey": "mono", "color": "rgb", "colour": "rgb",
}  # fmt: skip


def canonical_modality(name: str) -> str:
    """``rgb mono nir pol ms`` and their aliases; any other name is kept, in lower case."""
    name = name.strip().lower()
    return ALIASES.get(name, name)


@dataclass(frozen=True)
class Sensor:
    """One member of the rig: how its pixels sample light.

    Attributes:
        name: canonical modality name, unique in the scene.
        channels: one label per channel, in channel order.
        wavelengths_nm: one per channel, None where unknown or broad.
        mosaic: (k, k') int array, ``channel = mosaic[row % k][column % k']``; None: every pixel has all channels.
        polarizer_angles_deg: one per channel for a polarization sensor, measured from image right towards image up;
            None: plain radiance.
        saturation: raw values at or above it are taken as clipped.
    """

    name: str
    channels: tuple[str, ...]
    wavelengths_nm: tuple[float | None, ...]
    mosaic: np.ndarray | None = None
    polarizer_angles_deg: tuple[float, ...] | None = None
    saturation: float = 0.998

    @property
    def channel_count(self) -> int:
        return len(self.channels)

    @property
    def values_per_pixel(self) -> int:
        """Numbers that a frame has of each pixel: one under a mosaic, else one for each channel."""
        return self.channel_count if self.mosaic is None else 1

    @property
    def is_polarization(self) -> bool:
        return self.polarizer_angles_deg is not None


@dataclass(frozen=True)
class PosedCamera:
    """A camera at its place: all that it takes to render a picture or to project points.

    Attributes:
        camera: intrinsics and lens.
        camera_to_world: (4, 4) float64, rigid, OpenCV axes, in the scene's frame and unit.
        name: what files made of it are called; empty where nothing is.
    """

    camera: Camera
    camera_to_world: np.ndarray
    name: str = ""


@dataclass(frozen=True)
class StatedPose:
    """A pose as a file states it: a ``PosedCamera`` whose camera is None where the file has no intrinsics."""

    camera: Camera | None
    camera_to_world: np.ndarray
    name: str


@dataclass(frozen=True)
class Frame:
    """One image of one sensor.

    Attributes:
        sensor: name of its ``Sensor``.
        view: the id of the view (macroframe) in the input; ids may have gaps.
        path: the image file.
        camera: intrinsics and lens of this frame (one shared object where frames share it).
        camera_to_world: (4, 4) float64, rigid, OpenCV axes, in the scene's unit.
        source_name: the modality's folder or key as the input spells it (used to find masks and ground truth).
        mask: image file, non-zero = foreground; None where there is none.
    """

    sensor: str
    view: int
    path: Path
    camera: Camera
    camera_to_world: np.ndarray
    source_name: str = ""
    mask: Path | None = None


@dataclass(frozen=True)
class Region:
    """The region of interest: a ball in the world frame, in the scene's unit."""

    centre: tuple[float, float, float]
    radius: float


def ball(centre: np.ndarray, radius: float) -> Region:
    """The region around a point (3,)."""
    x, y, z = map(float, centre)
    return Region((x, y, z), radius)


@dataclass(frozen=True)
class Split:
    """View ids to train on and to test on; disjoint."""

    train: tuple[int, ...]
    test: tuple[int, ...]
    source: str


def make_split(views: Iterable[int], test: Iterable[int] = (), source: str = "") -> Split:
    """Split view ids by the ``test`` ids that the input states; the others train.

    Without any (or when they would leave nothing to train on) every tenth view tests: ids 9, 19, 29, ..., or the last
    view if no id ends with 9, or all do.
    """
    ids = sorted(set(views))
    stated = set(test)
    chosen = tuple(view for view in ids if view in stated)
    if not chosen or len(chosen) == len(ids):
        tenth = tuple(view for view in ids if view % 10 == 9)
        regular = 0 < len(tenth) < len(ids)
        chosen, source = (tenth, "every tenth view") if regular else (tuple(ids[-1:]), "the last view")
    return Split(tuple(view for view in ids if view not in chosen), chosen, source)


@dataclass(frozen=True)
class SceneSource:
    """All that it takes to read a scene again, as ``load_scene`` takes it and ``scene.toml`` adds to it; folders of pictures are absolute.

    Attributes:
        path: the folder or file.
        layout: None: the one that the folder holds.
        images: folder where the pictures are; None: where the layout says.
        also: folders of more sensors, by name, see ``scene.also``.
    """

    path: Path
    layout: Layout | None = None
    images: Path | None = None
    also: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Scene:
    """Everything a reader found.

    Attributes:
        root: the scene's folder. ``format``: which reader read it.
        sensors: by canonical name, in the input's order; the first is the reference.
        frames: sorted by (sensor order, view).
        region: region of interest.
        unit: "m" where the input says so, else "input unit".
        black_background: True when the input says that what is outside the object is black or transparent,
            None when it does not say.
        masks: what the frames' masks mean. mask_folder: where they were sought; None: where the layout has them.
        problems: one sentence each, to be shown by ``mmsynth info`` (missing images, dropped frames, ...).
        source: from what it was read; None where it was made in memory.
    """

    root: Path
    format: Layout
    sensors: dict[str, Sensor]
    frames: tuple[Frame, ...]
    region: Region
    split: Split
    unit: str = "input unit"
    black_background: bool | None = None
    masks: MaskMeaning = "off"
    mask_folder: Path | None = None
    problems: tuple[str, ...] = ()
    source: SceneSource | None = None

    def frames_of(self, sensor: str, views: tuple[int, ...] | None = None) -> tuple[Frame, ...]:
        """Frames of one sensor, optionally of some views only, in view order."""
        return tuple(f for f in self.frames if f.sensor == sensor and (views is None or f.view in views))


def keep_frames(scene: Scene, limits: Mapping[str, int]) -> Scene:
    """The same scene with at most N training frames of some modalities, evenly spread over its training views.

    Test frames and the other modalities are untouched.

    Args:
        limits: modality (name or alias) → N; a modality that has no more than N keeps all of them.
    Raises:
        InputError: the scene has no such modality, or N < 1.
    """
    dropped: set[tuple[str, int]] = set()
    for given, count in limits.items():
        name = canonical_modality(given)
        if name not in scene.sensors:
            raise InputError(f"{scene.root}: no modality {given!r}, expected one of {', '.join(scene.sensors)}.")
        if count < 1:
            raise InputError(f"{name}: {count} training frames to keep, expected at least 1.")
        views = [frame.view for frame in scene.frames_of(name, scene.split.train)]
        # the middle of each of N equal stretches
        kept = {views[(2 * i + 1) * len(views) // (2 * count)] for i in range(count)} if count < len(views) else set(views)
        dropped |= {(name, view) for view in views if view not in kept}
    return replace(scene, frames=tuple(f for f in scene.frames if (f.sensor, f.view) not in dropped))


def rig_of(scene: Scene) -> dict[str, np.ndarray]:
    """sensor → (4, 4) sensor_to_reference, from the first view that both saw; sensors that never shared a view are left out."""
    reference = next(iter(scene.sensors))
    poses = {f.view: f.camera_to_world for f in scene.frames_of(reference)}
    rig = {reference: np.eye(4)}
    for name in scene.sensors:
        for frame in scene.frames_of(name):
            if frame.view in poses:
                rig.setdefault(name, np.linalg.inv(poses[frame.view]) @ frame.camera_to_world)
    return rig
