"""A summary of a scene: ``describe`` as JSON, ``render_text`` as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, TypeVar

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.encoding import encoding_of
from mmsynth.scene.images import check_file, load_frame, read_native, used_bits
from mmsynth.scene.masks import read_mask
from mmsynth.scene.preview_colours import preview_colours_of
from mmsynth.scene.scene import Frame, Scene, Sensor
from mmsynth.scene.serialisation import sensor_to_json
from mmsynth.sensors.camera import Camera, round_trip_error

T = TypeVar("T")
_ENCODING_FRAMES = 4


def describe_scene(scene: Scene, measured_frames: int = 10) -> dict[str, Any]:
    """Summarise a scene as a JSON-serialisable dictionary.

    Every image file is checked to be complete; pixel statistics come from at most ``measured_frames`` frames per sensor, evenly
    spread over its views. Damaged images are listed under ``problems`` and do not raise.

    Returns:
        scene, format, unit, black_background, masks (what they mean), region {centre, radius}, split {train, test, source}, problems, and
        sensors: by name the dictionary of ``_describe_sensor``.
    """
    problems = list(scene.problems)
    sensors = {name: _describe_sensor(scene, sensor, measured_frames, problems) for name, sensor in scene.sensors.items()}
    return {
        "scene": str(scene.root),
        "format": scene.format,
        "unit": scene.unit,
        "black_background": scene.black_background,
        "masks": scene.masks,
        "region": {"centre": [float(value) for value in scene.region.centre], "radius": float(scene.region.radius)},
        "split": {"train": list(scene.split.train), "test": list(scene.split.test), "source": scene.split.source},
        "sensors": sensors,
        "problems": problems,
    }


def _describe_sensor(scene: Scene, sensor: Sensor, measured_frames: int, problems: list[str]) -> dict[str, Any]:
    """frames (and how many train, test, have a mask; foreground_percent: of the masks' pixels), size [width, height] of the first frame,
    channels, wavelengths_nm, mosaic, polarizer_angles_deg, file_type, bits in use and saturation (None: float data, never), pixel
    statistics mean, min, max, saturated_percent over frames_measured, and the lens of the first frame: its model, invalid_lens_pixels,
    photosites without a ray, round_trip_px, how far from its pixel a ray in float32 comes back at the most (of every n-th row and
    column where the frame has more than 250 000 pixels); encoding: how values stand to light, and why (``encoding.encoding_of``);
    preview_colours: for previews alone (``preview_colours.preview_colours_of``)."""
    frames = scene.frames_of(sensor.name)
    camera = frames[0].camera
    out: dict[str, Any] = {
        "frames": len(frames),
        "train": sum(frame.view in scene.split.train for frame in frames),
        "test": sum(frame.view in scene.split.test for frame in frames),
        "masks": sum(frame.mask is not None for frame in frames),
        "foreground_percent": None,
        "size": [camera.width, camera.height],
        "cameras": len({frame.camera for frame in frames}),
        **{key: value for key, value in sensor_to_json(sensor).items() if key != "name"},
        **_lens(camera),
    }
    for frame in frames:
        for path in (frame.path, frame.mask):
            if path is not None:
                _tried(problems, check_file, path)
    raw = _tried(problems, read_native, frames[0].path)
    if raw is None:
        out |= {"file_type": None, "bits": None}
    else:
        out |= {"file_type": str(raw.dtype), "bits": used_bits(raw) if raw.dtype.kind == "u" else raw.dtype.itemsize * 8}
    out |= _statistics(sensor, frames, measured_frames, problems)
    masked = [frame for frame in frames if frame.mask is not None]
    if masked:
        out["foreground_percent"] = _foreground_percent(sensor, masked, measured_frames, problems)
    encoding = _tried(problems, encoding_of, sensor, [frames[index].path for index in _spread(len(frames), _ENCODING_FRAMES)])
    colours = preview_colours_of(sensor, frames)
    out["preview_colours"] = None if colours is None else asdict(colours)
    out["encoding"] = None if encoding is None else asdict(encoding)
    if out["file_type"] == "uint16" and out["max"] is not None and out["max"] <= 4095 / 65535:
        problems.append(f"{sensor.name}: no value exceeds {out['max']:.3f} of full scale, as in 12-bit data that is not left-aligned.")
    return out


def _lens(camera: Camera, most: int = 250_000) -> dict[str, Any]:
    """Which model, how many photosites have no ray, because it has no inverse there, and how far off the rays of the others are."""
    step = math.ceil(math.sqrt(max(1.0, camera.width * camera.height / most)))
    v, u = np.mgrid[0 : camera.height : step, 0 : camera.width : step]
    error, missing = round_trip_error(camera, np.stack([u, v], -1).reshape(-1, 2).astype(np.float64))
    return {
        "lens": "pinhole" if camera.lens == "brown_conrady" and not any(camera.distortion) else camera.lens,
        "invalid_lens_pixels": round(missing * camera.width * camera.height),
        "round_trip_px": error if math.isfinite(error) else None,
    }


def _statistics(sensor: Sensor, frames: tuple[Frame, ...], most: int, problems: list[str]) -> dict[str, Any]:
    count, total, saturated, low, high = 0, 0.0, 0, math.inf, -math.inf
    measured = 0
    for index in _spread(len(frames), most):
        loaded = _tried(problems, load_frame, sensor, frames[index])
        if loaded is None:
            continue
        pixels = loaded[0]
        measured += 1
        count += pixels.size
        total += float(pixels.sum(dtype=np.float64))
        saturated += int(np.count_nonzero(pixels >= sensor.saturation))
        low, high = min(low, float(pixels.min())), max(high, float(pixels.max()))
    if not count:
        return {"frames_measured": 0, "mean": None, "min": None, "max": None, "saturated_percent": None}
    return {
        "frames_measured": measured,
        "mean": total / count,
        "min": low,
        "max": high,
        "saturated_percent": 100.0 * saturated / count,
    }


def _foreground_percent(sensor: Sensor, masked: Sequence[Frame], most: int, problems: list[str]) -> float | None:
    """Of the pixels of masks, evenly spread over the views; None where none can be read."""
    read = [_tried(problems, read_mask, masked[index]) for index in _spread(len(masked), most)]
    shares = [float(mask.mean()) for mask in read if mask is not None]
    if shares and not any(shares):
        problems.append(f"{sensor.name}: {len(shares)} masks were read and all are empty, expected pixels that are not zero.")
    return 100.0 * float(np.mean(shares)) if shares else None


def _spread(count: int, most: int) -> list[int]:
    """At most so many indices, evenly spread."""
    return sorted({round(index) for index in np.linspace(0, count - 1, min(most, count))})


def _tried(problems: list[str], read: Callable[..., T], *what: Any) -> T | None:
    """What a reader gives. A damaged file is found by the check and again by reading it: one sentence per file is enough."""
    try:
        return read(*what)
    except InputError as error:
        text = str(error)
        if not any(problem.split(": ")[0] == text.split(": ")[0] for problem in problems):
            problems.append(text)
        return None


# --- text


def render_text(description: dict[str, Any]) -> str:
    """The dictionary of ``describe_scene`` as plain text, some lines per sensor."""
    region, split = description["region"], description["split"]
    test = [*map(str, split["test"][:12]), *(["..."] if len(split["test"]) > 12 else [])]
    lines = [
        f"{description['scene']}  ({description['format']})",
        f"region   ball around ({', '.join(f'{value:.4g}' for value in region['centre'])}), "
        f"radius {region['radius']:.4g} {description['unit']}" + (", black background" if description["black_background"] else ""),
        f"views    {len(split['train'])} train, {len(split['test'])} test: {', '.join(test)} ({split['source']})",
    ]
    for name, sensor in description["sensors"].items():
        lines += ["", *_sensor_lines(name, sensor)]
    if description["problems"]:
        lines += ["", "problems", *(f"  - {problem}" for problem in description["problems"])]
    return "\n".join(lines) + "\n"


def _sensor_lines(name: str, sensor: dict[str, Any]) -> list[str]:
    width, height = sensor["size"]
    inside = "" if sensor["foreground_percent"] is None else f" (foreground: {sensor['foreground_percent']:.1f} % of the pixels)"
    masks = f", {sensor['masks']} with a mask{inside}" if sensor["masks"] else ""
    pattern = " / ".join(" ".join(map(str, row)) for row in sensor["mosaic"] or ())
    lines = [
        f"{name}",
        f"  frames    {sensor['frames']} ({sensor['train']} train, {sensor['test']} test{masks}), {width}x{height} pixels",
        f"  channels  {' '.join(sensor['channels'])}" + (f", mosaic {pattern}" if pattern else ""),
    ]
    if sensor["polarizer_angles_deg"] is not None:
        lines.append(
            f"  polarizer {' '.join(f'{angle:g}' for angle in sensor['polarizer_angles_deg'])} degrees, from image right towards image up"
        )
    if sensor["file_type"] is not None:
        lines.append(f"  files     {sensor['file_type']}, {sensor['bits']} bits in use")
    if sensor["mean"] is not None:
        lines.append(
            f"  values    {sensor['min']:.4f} to {sensor['max']:.4f}, mean {sensor['mean']:.4f}, "
            f"{sensor['saturated_percent']:.2f} % saturated (in {sensor['frames_measured']} frames)"
        )
    if sensor["encoding"] is not None:
        lines.append(f"  encoding  {sensor['encoding']['verdict']}: {sensor['encoding']['because']}")
    if sensor["preview_colours"] is not None:
        lines.append(f"  balance   {_colours(sensor['preview_colours'])}, for previews alone")
    back = (
        "no pixel has a ray"
        if sensor["round_trip_px"] is None
        else f"rays come back to their pixels within {sensor['round_trip_px']:.1g} px"
    )
    share = 100 * sensor["invalid_lens_pixels"] / (width * height)
    lost = f"; {sensor['invalid_lens_pixels']} pixels ({share:.2f} %) have no ray and are not used" if share else ""
    lines.append(f"  lens      {sensor['lens']}, {back}{lost}")
    return lines


def _colours(found: dict[str, Any]) -> str:
    rows = found["matrix"]
    if found["seen"] == "board":
        gains = " ".join(f"{rows[i][i]:.3f}" for i in range(3))
        return f"gains {gains} by a board's black and white, {found['count']} times (agree within {found['spread']:.1%})"
    text = "; ".join(" ".join(f"{value:.3f}" for value in row) for row in rows)
    return f"matrix {text} by the patches of a colour chart (agree within {found['spread']:.1%})"
