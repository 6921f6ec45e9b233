"""A full-size scene made of a small one: what a field fitted to the small scene shows through the same lenses on more pixels.

So a fit at full size has truth. The rays of every photosite are rendered by the field, at each scale anew (nothing is resampled), and a
twin of the sensor (``operations/simulation``) records them: mosaic, noise, rounding. What the field does not know, no frame shows: there is
no finer texture than its hash grids hold. Its surfaces are made as hard as the new pixels can tell: those of the small scene are a pixel of
the small scene thick, a fog in which no surface is right (``as_hard_as_pixels``).

A scene has some of the small scene's views, test views among them, in an order in which each number of views holds those of all smaller
numbers: a scene that was made with few views grows by making it again with more. Layout: that of ``simulate``, and of the test views ::

    gt/NAME/0009.npz           data (H, W, C) float16, of polarization Stokes vectors (H, W, 3); made_of: what it was made of
    gt/masks/0009_NAME.npz     in_roi (H, W) bool

Half precision is off by 1/2000 of a value at the most: 78 dB where light is at full scale. Frames are 16-bit PNG: of 2464 x 1848 photosites
with noise it takes 5.2 MB and 0.04 s of processor time to read (TIFF with zlib: 6.9 MB and as long; without: 9.1 MB, and 1 ms).
"""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import write_text
from mmsynth.fitting.needs import pixel_sizes
from mmsynth.operations.output.progress import Counter, Progress, parts
from mmsynth.operations.output.records import field_hash
from mmsynth.operations.simulation.simulate import simulate
from mmsynth.operations.views.load import views_of_frames
from mmsynth.scene.image_writers import write_npz
from mmsynth.scene.images import read_npz
from mmsynth.scene.scene import PosedCamera, Scene
from mmsynth.scene.serialisation import posed_to_json
from mmsynth.sensors.camera import Camera, resized
from mmsynth.sensors.noise import NoiseModel
from mmsynth.sensors.sensor_file import SensorFile, sensor_to_toml

if TYPE_CHECKING:
    from mmsynth.field.field import Field

FULL_WIDTH = 2464
"""Pixels in a row of full size, of 2464 x 2056: the largest sensor of the MMS-DATA rig that is no prototype."""
_SHARPNESS = 4.0  # times 1 / footprint: a soft surface is 3.5 / sharpness thick, about a pixel
_TESTS = 10  # one view of so many tests
# of an ordinary machine-vision sensor, EMVA 1288: 12 bits, 10 000 electrons at full scale, 5 electrons of read noise
_NOISE = NoiseModel(bits=12, gain_dn_e=0.4095, full_well_e=1e4, read_e=5.0)


def full_size_camera(camera: Camera, scale: float = 1.0, width: int = FULL_WIDTH) -> Camera:
    """The lens and field of view of a camera on ``scale * width`` pixels in a row; the distortion is that of the lens and stays."""
    return resized(camera, max(1, round(scale * width)))


def views_to_make(scene: Scene, count: int | None = None) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Training and test views of a scene of ``count`` views (None: all), each in view order.

    Of ten views one tests, at least one. Those of a smaller number are among those of a larger one, each number spread over the scene.

    Raises:
        InputError: the scene has fewer views, or fewer than two are asked for.
    """
    train, test = (_spread(views) for views in (scene.split.train, scene.split.test))
    most = len(train) + len(test)
    count = most if count is None else count
    tests = min(max(1, count // _TESTS), len(test))
    if not 2 <= count <= most or count - tests > len(train):
        raise InputError(f"{scene.root}: {count} views of a full-size scene, expected 2 to {len(train) + tests} of its {most} views.")
    return tuple(sorted(train[: count - tests])), tuple(sorted(test[:tests]))


def make_full_size(
    field: Field,
    scene: Scene,
    out: Path,
    *,
    scale: float = 1.0,
    width: int = FULL_WIDTH,
    views: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Path:
    """Make the scene, or go on where it was left: what is there and whole is not rendered again.

    Args:
        field: fitted to ``scene``; its corrections of poses are in the poses of the new scene. scale: of ``width``, pixels in a row.
        views: how many, see ``views_to_make``. seed: of the noise. progress: called with thousandths of the rays.
    Returns:
        the path of ``meta_data.json``, written last.
    Raises:
        InputError: see ``views_to_make``; a scene that has no frame of a sensor at a view; the disk refused.
    """
    train, test = views_to_make(scene, views)
    out = Path(out)
    # while test views lack their truth nothing may vouch for the scene
    (out / "meta_data.json").unlink(missing_ok=True)
    cameras = {name: full_size_camera(field.cameras[name], scale, width) for name in field.measured}
    field = as_hard_as_pixels(field, scene, cameras)
    files = []
    for name, camera in cameras.items():
        files.append(out / "sensors" / f"{name}.toml")
        figures = {"name": name, "description": "of a full-size scene", "instance_of": name, "camera": camera, "noise": _NOISE}
        write_text(files[-1], sensor_to_toml(SensorFile.model_validate(figures)))
    of_truth = len(test) / (len(train) + 2 * len(test))
    truth, frames = parts(progress, (of_truth, 1.0 - of_truth))
    _write_truth(field, scene, cameras, test, out, truth)
    made = simulate(field, files, out, frames=[*test, *train], scene=scene, seed=seed, progress=frames)
    assert made is not None  # one process makes all of it
    return made


def as_hard_as_pixels(field: Field, scene: Scene, cameras: Mapping[str, Camera]) -> Field:
    """The field with surfaces that are about a pixel of ``cameras`` thick, at the region's centre; itself where they are no thicker.

    Measured on a room that 160 x 120 pixels had taught, shown on 2464: surfaces 13 pixels thick, of which a fit's sharper ones took 4 dB.
    """
    frames = [frame for name in cameras for frame in scene.frames_of(name)]
    origins = np.array([field.pose_of(frame)[:3, 3] for frame in frames])
    normalised = (origins - np.array(field.region.centre)) / field.region.radius
    footprint = float(np.median(pixel_sizes(normalised, [cameras[frame.sensor] for frame in frames])))
    harder = _SHARPNESS / footprint / field.sampling.sharpness
    if harder <= 1.0:
        return field
    hard = copy.copy(field)  # its tensors are shared
    hard.sampling = field.sampling._replace(sharpness=field.sampling.sharpness * harder, step=field.sampling.step / harder)
    return hard


def _spread(views: Sequence[int]) -> list[int]:
    """In an order in which the first of any number of them are spread over all: by the bits of their places, mirrored (van der Corput)."""
    bits = max(1, (len(views) - 1).bit_length())
    mirrored = sorted(range(len(views)), key=lambda i: int(f"{i:0{bits}b}"[::-1], 2))
    return [views[i] for i in mirrored]


def _write_truth(field: Field, scene: Scene, cameras: dict[str, Camera], test: Sequence[int], out: Path, progress: Progress | None) -> None:
    """Noise-free light of the test views, and where they see the region of interest."""
    digest = field_hash(field)
    count = Counter(progress, len(test) * sum(camera.width * camera.height for camera in cameras.values()))
    for name, camera in cameras.items():
        for view in views_of_frames(field, scene, name, test):
            at = PosedCamera(camera, view.camera_to_world, view.name)
            path, mask = out / "gt" / name / f"{at.name}.npz", out / "gt" / "masks" / f"{at.name}_{name}.npz"
            made_of = hashlib.sha256(json.dumps([digest, posed_to_json(at)]).encode()).hexdigest()
            goal = count.done + camera.width * camera.height
            if not (_is_whole(path, made_of) and _is_whole(mask, made_of)):
                seen = field.render(camera, at.camera_to_world, [name], geometry=False, progress=count)
                light = seen.stokes[name] if name in seen.stokes else seen.channels[name]
                write_npz(path, {"data": light.astype(np.float16), "made_of": np.array(made_of)})
                write_npz(mask, {"in_roi": seen.opacity > 0.5, "made_of": np.array(made_of)})
            count(goal - count.done)


def _is_whole(path: Path, made_of: str) -> bool:
    try:
        return path.is_file() and str(read_npz(path)["made_of"]) == made_of  # every array is read, and its checksum compared
    except (InputError, KeyError):
        return False
