"""What each method says of a frame: the target's light on the target's pixels.

* ``field``: the field's rendering alone.
* ``ratio``: times the local gain between the frame and the field's rendering of it, as far as the target varies with the source
  (``guidance``). Of polarization all Stokes components alike: DoLP and AoLP stay the field's.
* ``guided``: the ratio, and what colour the frame has beyond it, through a local linear map learned from the field's own renderings.
* ``linear``: the frame's values through one linear map, learned from the field's renderings of training poses (a colour matrix of the
  scene).
* ``nearest``: the training frame of the target whose camera stands nearest, carried over through the surface.

Where a method has nothing to say, its value is the field's.

What ``guided`` gives is not projected onto what reproduces the source exactly: as the map from target to source is learned, too, that took
0.7 dB from one scene with ground truth and gave 0.02 to another.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
import torch

from mmsynth.errors import InputError
from mmsynth.operations.conversion.guidance import Guide, gain_exponent, guide, mapped_colour
from mmsynth.operations.conversion.warping import warped
from mmsynth.operations.conversion.windows import WINDOW, opened
from mmsynth.operations.output.progress import RaysDone
from mmsynth.scene.scene import Frame, PosedCamera, Scene, Sensor
from mmsynth.sensors.camera import resized
from mmsynth.sensors.mosaic import channels_of
from mmsynth.sensors.polarization import intensities_to_stokes

if TYPE_CHECKING:
    from mmsynth.field.field import Field
    from mmsynth.field.picture import Rendering

Prediction = Literal["field", "ratio", "guided", "linear", "nearest"]
PREDICTIONS: tuple[Prediction, ...] = get_args(Prediction)
OF_THE_SCENE: tuple[Prediction, ...] = ("linear", "nearest")
"""They need the scene's training frames."""
WARPED_SHARE = 0.6
"""Of a correction is right where it arrives through the surface: measured, on two scenes with ground truth."""
_LEARNED_FROM, _LEARNED_WIDTH = 8, 80  # renderings for the linear map, and px in a row of them


@dataclass(frozen=True)
class Training:
    """What the training frames bring to conversions of one pair.

    Attributes:
        matrix: (C + 1, K), least squares from the source's channels and 1 to the target's light. frames: of the target.
    """

    matrix: np.ndarray
    frames: tuple[Frame, ...]


@dataclass(frozen=True)
class Compared:
    """A frame of the source, and the field's rendering of it with the target's channels, too."""

    raw: np.ndarray
    view: PosedCamera
    seen: Rendering
    guidance: Guide


@dataclass(frozen=True)
class Predictions:
    """On the target's pixels (H, W).

    Attributes:
        there: the field's rendering. light: per method (H, W, K), of a polarization target Stokes (H, W, 3); float32, NaN where the lens
            has no ray. told: per method, where it has a say; of ``field`` where corrections would have one.
        gain_sd: of the gain. unexplained: where the frame shows what the field does not have.
    """

    there: Rendering
    light: dict[Prediction, np.ndarray]
    told: dict[Prediction, np.ndarray]
    gain_sd: np.ndarray
    unexplained: np.ndarray


def in_one_place(a: PosedCamera, b: PosedCamera) -> bool:
    """Whether two cameras have the same pixels of the same scene: nothing is carried from one to the other."""
    return a.camera == b.camera and np.allclose(a.camera_to_world, b.camera_to_world, rtol=0.0, atol=1e-9)


def light_of(seen: Rendering, sensor: Sensor) -> np.ndarray:
    """(H, W, K) channels, of polarization Stokes (H, W, 3)."""
    return seen.stokes[sensor.name] if sensor.is_polarization else seen.channels[sensor.name]


def as_light(values: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Channels (..., K) → of polarization Stokes vectors (..., 3)."""
    if sensor.polarizer_angles_deg is None:
        return values
    return intensities_to_stokes(torch.from_numpy(np.asarray(values, np.float32)), sensor.polarizer_angles_deg).numpy()


def _physical(light: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Stokes vectors (..., 3) no more polarized than they are bright; means of such are so, too. Other light is left as it is."""
    if not sensor.is_polarization:
        return light
    s0, linear = np.maximum(light[..., :1], 0.0), light[..., 1:]
    return np.concatenate([s0, linear * np.minimum(1.0, s0 / np.maximum(np.linalg.norm(linear, axis=-1, keepdims=True), 1e-12))], -1)


def _polarized_as(light: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Stokes vectors (..., 3) of the S0 of one and the polarization of another."""
    return np.maximum(light[..., :1], 0.0) * np.concatenate(
        [np.ones_like(other[..., :1]), other[..., 1:] / np.maximum(other[..., :1], 1e-9)], -1
    )


def learn_training(field: Field, scene: Scene, source: str, target: str) -> Training:
    """From the scene's training frames, small renderings of eight of them.

    Raises:
        InputError: no training frames of the source or of the target.
    """
    for name in (source, target):
        if not scene.frames_of(name, scene.split.train):
            raise InputError(f"{scene.root}: no training frames of {name}, expected some to learn conversions from.")
    frames = scene.frames_of(source, scene.split.train)
    xs, ys = [], []
    for frame in frames[:: max(1, len(frames) // _LEARNED_FROM)]:
        camera = frame.camera if frame.camera.width <= _LEARNED_WIDTH else resized(frame.camera, _LEARNED_WIDTH)
        seen = field.render(camera, field.pose_of(frame), list(dict.fromkeys((source, target))), geometry=False)
        x = seen.channels[source][seen.valid].astype(np.float64)
        xs.append(np.concatenate([x, np.ones((len(x), 1))], 1))
        ys.append(light_of(seen, field.sensors[target])[seen.valid].astype(np.float64))
    x, y = np.concatenate(xs), np.concatenate(ys)
    matrix = np.linalg.solve(x.T @ x + 1e-6 * len(x) * np.eye(x.shape[1]), x.T @ y)
    return Training(matrix, scene.frames_of(target, scene.split.train))


def compare(field: Field, raw: np.ndarray, view: PosedCamera, source: str, target: str, *, progress: RaysDone | None = None) -> Compared:
    """Render a frame of the source and compare (see ``guidance``).

    Raises:
        InputError: a frame of another size.
    """
    sensor = field.sensors[source]
    expected = (view.camera.height, view.camera.width) + (() if sensor.mosaic is not None else (sensor.channel_count,))
    if raw.shape != expected:
        raise InputError(f"convert: a frame of shape {raw.shape}, expected {expected} of {source}.")
    seen = field.render(view.camera, view.camera_to_world, list(dict.fromkeys((source, target))), geometry=False, progress=progress)
    return Compared(raw, view, seen, guide(raw, seen.channels[source], sensor, seen.valid))


def predict(
    field: Field,
    compared: Compared,
    source: str,
    target: str,
    methods: Collection[Prediction],
    *,
    training: Training | None = None,
    seen_by: PosedCamera | None = None,
    left_out: int | None = None,
    to_weigh: bool = False,
    of_region: bool = False,
    progress: RaysDone | None = None,
) -> Predictions:
    """What ``methods`` say, and ``field`` always.

    Args:
        training: for the methods ``OF_THE_SCENE``. seen_by: camera and pose of the target, None: the source's own pixels. left_out: view
            whose frame ``nearest`` must not use. to_weigh: as evidence weighs them: a correction arrives
            through the surface in full, as what that costs is seen, and of polarization ``linear`` and ``nearest`` say S0 alone, as they
            know DoLP and AoLP less than the field does.
        of_region: of the nearest frame, too, use only a window around the region of interest.
    """
    sensor, seen, guidance, view = field.sensors[target], compared.seen, compared.guidance, compared.view
    of_light = sensor.is_polarization  # one gain for all of a Stokes vector
    shown = seen.channels[target].mean(-1, keepdims=True) if of_light else seen.channels[target]
    gain = np.maximum(guidance.gain, 1e-3).astype(np.float32)[..., None] ** gain_exponent(seen.channels[source], shown, seen.valid)
    colour = np.zeros((*seen.valid.shape, light_of(seen, sensor).shape[-1]), np.float32)
    if "guided" in methods and not of_light:
        colour = mapped_colour(seen.channels[source], seen.channels[target], seen.valid, guidance.residual_colour)
    mapped = np.zeros_like(colour)
    if "linear" in methods:
        assert training is not None
        matrix = training.matrix.astype(np.float32)
        mapped = channels_of(compared.raw, field.sensors[source].mosaic).astype(np.float32) @ matrix[:-1] + matrix[-1]
    there, told, gain_sd, unexplained = seen, seen.valid & ~guidance.unexplained, guidance.gain_sd, guidance.unexplained
    covered = seen.valid
    if seen_by is not None and not in_one_place(view, seen_by):
        there = field.render(seen_by.camera, seen_by.camera_to_world, [target], geometry=False, progress=progress)
        share = 1.0 if to_weigh else WARPED_SHARE
        gain, colour = gain**share, colour * share
        layers, widths = (
            [gain, colour, mapped, gain_sd, seen.valid, unexplained],
            [gain.shape[-1], colour.shape[-1], mapped.shape[-1], 1, 1],
        )
        arrived, visible = warped(np.dstack(layers), seen, view, there, seen_by)
        gain, colour, mapped, gain_sd, ray, new = np.split(arrived, np.cumsum(widths), -1)
        gain_sd, covered, unexplained = gain_sd[..., 0], visible, visible & (new[..., 0] > 0.5)
        told = visible & (ray[..., 0] > 0.99) & ~unexplained
    field_says = light_of(there, sensor)
    corrected = field_says * np.where(told[..., None], gain, 1.0)
    light: dict[Prediction, np.ndarray] = {"field": field_says}
    where: dict[Prediction, np.ndarray] = {"field": told}
    if "ratio" in methods:
        light["ratio"], where["ratio"] = corrected, told
    if "guided" in methods:
        light["guided"], where["guided"] = corrected + np.where(told[..., None], colour, 0.0), told
    if "linear" in methods:
        light["linear"], where["linear"] = np.where(covered[..., None], _physical(mapped, sensor), field_says), covered
    if "nearest" in methods:
        assert training is not None
        light["nearest"], where["nearest"] = _nearest(field, training.frames, sensor, there, seen_by or view, left_out, of_region)
    if to_weigh and of_light:
        light |= {name: _polarized_as(light[name], field_says) for name in OF_THE_SCENE if name in light}
    return Predictions(there, light, where, gain_sd, unexplained)


def _nearest(
    field: Field,
    frames: Sequence[Frame],
    sensor: Sensor,
    there: Rendering,
    seen_by: PosedCamera,
    left_out: int | None,
    of_region: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """The training frame whose camera stands nearest, carried over, and where it sees the surface."""
    field_says = light_of(there, sensor)
    others = [frame for frame in frames if frame.view != left_out]
    if not others:
        return field_says, np.zeros_like(there.valid)
    centre = seen_by.camera_to_world[:3, 3]
    frame = min(others, key=lambda f: float(np.linalg.norm(field.pose_of(f)[:3, 3] - centre)))
    raw, view = opened(field, frame, WINDOW if of_region else None)
    seen = field.render(view.camera, view.camera_to_world, [], geometry=False)
    values = as_light(channels_of(raw, sensor.mosaic), sensor)
    carried, visible = warped(np.where(seen.valid[..., None], values, 0.0), seen, view, there, seen_by)
    return np.where(visible[..., None], _physical(carried, sensor), field_says), visible
