"""A sensor's digital twin at any poses: the raw frames that it would have recorded, as a scene that can be fitted again.

Layout of ``<out>``: an MMS-DATA scene in the preprocessed raw layout, and beside it what made it ::

    meta_data.json                    written last; the world is the region's ball, ``worldtogt`` takes it to the field's frame
    modalities/NAME/0009.png          raw mosaic in the sensor's bits (or .tiff, or .dng for a Bayer pattern); an instance has the name
                                      of its modality
    sensors/NAME.toml                 the sensor file
    sidecars/NAME/0009.json           all that made the frame: sensor, seed, camera, pose, field, stages, hash; written last of its frame

A run that is cut off goes on where it was: a frame whose sidecar belongs to the same request and whose file has the stated hash is not
made again. The same field, sensor, poses and seed give the same bytes, whatever else is made, in any order.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.files import read_json, sha256_of, write_json, write_text
from mmsynth.operations.conversion.files import source_views
from mmsynth.operations.output.progress import Counter, Progress
from mmsynth.operations.output.records import field_hash
from mmsynth.operations.output.work_partition import Share
from mmsynth.operations.views.trajectories import View
from mmsynth.scene.image_writers import write_dng, write_png, write_tiff
from mmsynth.scene.layouts.mmsdata import meta_content
from mmsynth.scene.scene import PosedCamera, Scene, Sensor, canonical_modality
from mmsynth.scene.serialisation import CONVENTIONS, posed_to_json
from mmsynth.sensors.camera import Camera, resized
from mmsynth.sensors.mosaic import crop_pattern, is_bayer
from mmsynth.sensors.sensor_file import SensorFile, find_sensor_file, load_sensor, sensor_to_toml
from mmsynth.sensors.spectral import Combination, combine, require_expressible
from mmsynth.sensors.twin import SensorTwin, aperture, blur, blur_radius
from mmsynth.version import __version__

if TYPE_CHECKING:
    from mmsynth.field.field import Field

FORMATS = ("png", "tiff", "dng")
RIGS = ("native", "aligned")
VIRTUAL_SUPERSAMPLING = 2
_STRIP_RAYS = 1 << 18
IN_THE_FIELD = ("response", "exposure", "psf", "aperture", "vignetting", "analysers", "crosstalk")  # of a sensor that it learned from
STAGES = (
    "psf", "aperture", "exposure", "vignetting", "mosaic", "analyser", "prnu", "shot noise of light and dark current", "crosstalk",
    "read noise", "row noise", "full well", "gain", "black level", "rounding",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Simulated:
    """A sensor on a field: what to render, and how that becomes its light.

    Attributes:
        file: its figures, without those effects that the field has already. sensor: as a scene describes it. camera: None: of each view.
        to_reference: (4, 4) its place on the rig. modalities: of the field, to be rendered. supersampling: rays per pixel along each axis.
        light: rendered channels and Stokes vectors (H, W, ·) → (C, H, W) light, or (C, 3, H, W) Stokes vectors if ``polarized``.
        combinations: of virtual channels, by label.
    """

    file: SensorFile
    sensor: Sensor
    camera: Camera | None
    to_reference: np.ndarray
    modalities: tuple[str, ...]
    supersampling: int
    polarized: bool
    light: Callable[[dict[str, np.ndarray], dict[str, np.ndarray]], np.ndarray]
    combinations: dict[str, Combination]


def plan_sensor(field: Field, path: Path, delta: bool = False) -> Simulated:
    """Read a sensor file and find out how the field can play it.

    Args:
        delta: of an instance, apply the file's exposure, blur, vignetting, crosstalk and analysers on top of those that the field learned.
    Raises:
        InputError: bad file; a modality or channel that the field does not have; an effect that would be applied twice; a virtual channel
            that the measured ones cannot express.
    """
    file = load_sensor(path)
    return _instance(field, file, path, delta) if file.instance_of is not None else _virtual(field, file, path)


def _instance(field: Field, file: SensorFile, path: Path, delta: bool) -> Simulated:
    name = canonical_modality(file.instance_of or "")
    if name not in field.sensors:
        raise InputError(f"{path}: instance_of: {file.instance_of!r} is not in this field, expected one of {', '.join(field.sensors)}.")
    captured = field.sensors[name]
    stated = [c.label for c in file.channels]
    if stated and stated != list(captured.channels):
        raise InputError(f"{path}: channels are {', '.join(stated)}, expected those of {name}: {', '.join(captured.channels)}.")
    pattern = _pattern(file)
    if pattern is not None and not np.array_equal(pattern, np.zeros((1, 1)) if captured.mosaic is None else captured.mosaic):
        raise InputError(f"{path}: mosaic: {pattern.tolist()} is not that of {name} in this field, {_listed(captured.mosaic)}.")
    if not delta:
        for key in ("exposure", "psf_sigma_px", "vignetting", "cos4", "polarizer_angle_sd_deg"):
            if getattr(file, key) != SensorFile.model_fields[key].default:
                raise InputError(
                    f"{path}: {key}: the field learned from the frames of {name} and has its {key} already; leave it out, or say --delta "
                    "to apply it on top."
                )
        if file.noise.crosstalk:
            raise InputError(f"{path}: noise.crosstalk: the field has that of {name} already; leave it out, or say --delta.")
    polarized = delta and captured.is_polarization and any(c.polarizer for c in file.channels)

    def light(channels: dict[str, np.ndarray], stokes: dict[str, np.ndarray]) -> np.ndarray:
        if polarized:
            return np.broadcast_to(_stokes_light(file, stokes[name])[None], (len(file.channels), 3, *stokes[name].shape[:2]))
        return np.moveaxis(file.light_of(channels[name]), -1, 0)

    return Simulated(
        file=file,
        sensor=captured,
        camera=file.camera or field.cameras.get(name),
        to_reference=_place(file, field.rig.get(name, np.eye(4))),
        modalities=(name,),
        supersampling=file.supersampling or 1,
        polarized=polarized,
        light=light,
        combinations={},
    )


def _virtual(field: Field, file: SensorFile, path: Path) -> Simulated:
    facts = {canonical_modality(f.instance_of): f for f in _measured(file, path) if f.instance_of is not None}
    for name, fact in facts.items():
        if name in field.sensors and [c.label for c in fact.channels] != list(field.sensors[name].channels):
            raise InputError(
                f"{path}: measured: the channels of {fact.name} are {', '.join(c.label for c in fact.channels)}, "
                f"expected those of {name} in this field: {', '.join(field.sensors[name].channels)}."
            )
    known = [
        ((name, i), c.response)
        for name, fact in facts.items()
        if name in field.sensors and not field.sensors[name].is_polarization
        for i, c in enumerate(fact.channels)
        if c.response is not None
    ]
    # each channel: weights of trained channels, or none where it is the polarization sensor's own light
    recipes: list[dict[tuple[str, int], float] | None] = []
    combinations = {}
    for c in file.channels:
        where = f"{path}: channels: {c.label}"
        if c.of is not None:
            recipes.append({_trained(field, c.of, where): 1.0})
        elif c.response is not None:
            if not known:
                raise InputError(f"{where}: none of the measured sensors ({', '.join(file.measured)}) is in this field with a response.")
            found = combine(c.response, [r for _, r in known])
            require_expressible(found, where)
            combinations[c.label] = found
            recipes.append({key: float(w) for (key, _), w in zip(known, found.weights, strict=True)})
        else:
            recipes.append(None)
    polarized = any(c.polarizer for c in file.channels)
    by = next((n for n, s in field.sensors.items() if s.is_polarization), None)
    if polarized and by is None:
        raise InputError(f"{path}: channels: polarizers need a field that learned from a polarization sensor, this one has none.")
    pattern = _pattern(file)

    def level(channels: dict[str, np.ndarray], weights: dict[tuple[str, int], float]) -> np.ndarray:
        of = lambda name: facts[name].light_of if name in facts else lambda value: value
        return np.asarray(sum(w * of(name)(channels[name][..., i]) for (name, i), w in weights.items()))

    def light(channels: dict[str, np.ndarray], stokes: dict[str, np.ndarray]) -> np.ndarray:
        if not polarized:
            return np.stack([level(channels, r) for r in recipes if r is not None])
        assert by is not None
        own = _stokes_light(facts[by], stokes[by]) if by in facts else np.moveaxis(stokes[by], -1, 0)
        share = np.divide(own, own[:1], out=np.zeros_like(own), where=own[:1] > 0)
        share[0] = 1.0
        return np.stack([own if r is None else level(channels, r) * share for r in recipes])

    used = {name for r in recipes if r is not None for name, _ in r} | ({by} if polarized and by is not None else set())
    peaks = [c.response.centre_nm if c.response is not None else None for c in file.channels]
    sensor = Sensor(
        name=canonical_modality(file.name),
        channels=tuple(c.label for c in file.channels),
        wavelengths_nm=tuple(peaks),
        mosaic=pattern if len(file.channels) > 1 else None,
        polarizer_angles_deg=tuple(c.polarizer.angle_deg for c in file.channels if c.polarizer) or None,
    )
    return Simulated(
        file=file,
        sensor=sensor,
        camera=file.camera,
        to_reference=_place(file, np.eye(4)),
        modalities=tuple(n for n in field.sensors if n in used),
        supersampling=file.supersampling or VIRTUAL_SUPERSAMPLING,
        polarized=polarized,
        light=light,
        combinations=combinations,
    )


def _stokes_light(file: SensorFile, stokes: np.ndarray) -> np.ndarray:
    """(H, W, 3) of values → (3, H, W) of light: S0 is the sum of two intensities and holds the black level twice."""
    scale = file.dn_at_one / (file.noise.white_dn - file.noise.black_dn)
    black = np.array([2.0 * file.noise.black_dn / (file.noise.white_dn - file.noise.black_dn), 0.0, 0.0])
    return np.moveaxis(stokes * scale - black, -1, 0)


def _measured(file: SensorFile, path: Path) -> list[SensorFile]:
    found = [(p, load_sensor(p)) for p in (find_sensor_file(name, path.parent) for name in file.measured)]
    for p, other in found:
        if other.instance_of is None:
            raise InputError(f"{path}: measured: {p} is a virtual sensor, expected the file of a captured one (key 'instance_of').")
    return [other for _, other in found]


def _trained(field: Field, of: str, where: str) -> tuple[str, int]:
    modality, _, label = of.partition(".")
    name = canonical_modality(modality)
    if name not in field.sensors or label not in field.sensors[name].channels:
        known = [f"{n}.{c}" for n, s in field.sensors.items() for c in s.channels]
        raise InputError(f"{where}: of: no trained channel {of!r}, expected one of {', '.join(known)}.")
    return name, field.sensors[name].channels.index(label)


def _pattern(file: SensorFile) -> np.ndarray | None:
    return None if file.mosaic is None else crop_pattern(np.array(file.mosaic, np.int64), file.mosaic_offset)


def _listed(mosaic: np.ndarray | None) -> Any:
    return "none" if mosaic is None else mosaic.tolist()


def _place(file: SensorFile, default: np.ndarray) -> np.ndarray:
    return default if file.camera_to_reference is None else np.array(file.camera_to_reference)


# --- frames


def render_light(
    field: Field, planned: Simulated, camera: Camera, pose: np.ndarray, progress: Callable[[int], None] | None = None
) -> Tensor:
    """The light on a sensor's pixels, blur and aperture included: (C, H, W), with polarizers (C, 3, H, W); float32. Dark where the lens
    has no ray. By strips of the picture: the finer grid of a whole one may not fit into memory.
    """
    s, sigma = planned.supersampling, planned.file.psf_sigma_px * planned.supersampling
    fine = resized(camera, s * camera.width)
    margin = s * math.ceil(blur_radius(sigma) / s)
    rows = max(margin, s * max(1, _STRIP_RAYS // (fine.width * s)))

    def strip(top: int) -> Tensor:
        part = dataclasses.replace(fine, height=min(rows, fine.height - top), cy=fine.cy - top)
        seen = field.render(part, pose, planned.modalities, geometry=False, progress=progress)
        light = planned.light({n: x.astype(np.float64) for n, x in seen.channels.items()}, seen.stokes)
        return torch.from_numpy(np.where(seen.valid, light, 0.0).astype(np.float32))

    out = []
    above, here = None, strip(0)
    for top in range(0, fine.height, rows):
        below = strip(top + rows) if top + rows < fine.height else None
        # a blur needs what lies above and below; at the picture's own border it repeats it
        before = above[..., -margin:, :] if above is not None and margin else here[..., :0, :]
        after = below[..., :margin, :] if below is not None else here[..., :0, :]
        blurred = blur(torch.cat([before, here, after], -2), sigma)
        out.append(aperture(blurred[..., before.shape[-2] : before.shape[-2] + here.shape[-2], :], s))
        above, here = here, below if below is not None else here
    return torch.cat(out, -2)


def simulate_frame(
    field: Field,
    planned: Simulated,
    camera: Camera,
    pose: np.ndarray,
    frame: int,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> np.ndarray:
    """One raw frame [DN] as the converter gives it: (H, W), or (H, W, C) without mosaic; uint16."""
    twin = SensorTwin(planned.file, camera, planned.sensor.mosaic, seed, planned.polarized)
    light = render_light(field, planned, camera, pose, progress)
    numbers = twin.record(twin.expose(light[None]), [frame])[0].numpy().astype(np.uint16)
    if numbers.ndim == 2:
        return numbers
    return numbers[0] if len(numbers) == 1 else np.moveaxis(numbers, 0, -1)


# --- files


def simulate(
    field: Field,
    sensors: Sequence[str | Path],
    views: Sequence[View],
    out: Path | str,
    seed: int = 0,
    format: str = "png",
    rig: str = "native",
    delta: bool = False,
    share: Share | None = None,
    progress: Progress | None = None,
) -> Path | None:
    """Simulate sensors at views and write them as a scene (layout: module docstring).

    Args:
        sensors: sensor files, or names of packaged ones. views: of the rig's reference; a view whose name is a number keeps it as its id.
        seed: of all noise and patterns. rig: "native": each sensor at its place on the rig; "aligned": all at the view's own pose.
        delta: see ``plan_sensor``. share: the part of the frames that this process makes, None: all.
        progress: called with (rays done, rays in all).
    Returns:
        the path of ``meta_data.json``; None where other processes have not finished their frames yet: the last one writes it.
    Raises:
        InputError: see ``plan_sensor``; no views; two sensors of one name; a format that cannot hold a sensor; the disk refused.
    """
    if rig not in RIGS:
        raise InputError(f"simulate: rig is {rig!r}, expected one of {', '.join(RIGS)}.")
    if not views:
        raise InputError("simulate: no views, expected at least one.")
    planned = _planned(field, sensors, format, delta)
    requests = []
    for p in planned:
        for camera, pose, name in views:
            requests.append((p, p.camera or camera, pose if rig == "aligned" else pose @ p.to_reference, name))
    return _write(field, planned, requests, Path(out), seed, format, share or Share(), progress)


def simulate_at_frames(
    field: Field,
    scene: Scene,
    sensors: Sequence[str | Path],
    out: Path | str,
    chosen: Sequence[int] | None = None,
    seed: int = 0,
    format: str = "png",
    delta: bool = False,
    share: Share | None = None,
    progress: Progress | None = None,
) -> Path | None:
    """``simulate`` at the frames of the scene itself, with their ids: an instance at the frames of its own sensor, as the fit corrected
    their poses; a virtual sensor at those of the first one.

    Args:
        chosen: view ids; None: all.
    """
    first = next(iter(scene.sensors))
    planned = _planned(field, sensors, format, delta)
    requests = []
    for p in planned:
        if p.file.instance_of is not None:
            views = source_views(field, scene, p.file.instance_of, chosen)
            requests += [(p, p.file.camera or camera, pose, name) for camera, pose, name in views]
        else:
            views = source_views(field, scene, first, chosen)
            requests += [(p, p.camera or camera, pose @ p.to_reference, name) for camera, pose, name in views]
    return _write(field, planned, requests, Path(out), seed, format, share or Share(), progress)


def foretold(scene: Path) -> list[str]:
    """A line for each virtual sensor of a simulated scene whose channels are made of measured ones: how far off they are expected to be."""
    lines = []
    for folder in sorted((scene / "sidecars").iterdir()):
        made = read_json(min(folder.iterdir()))["channels_made_of"]
        if made:
            errors = {label: c["residual"] for label, c in made.items()}
            worst = max(errors, key=lambda label: errors[label])
            lines.append(
                f"{folder.name}: {len(made)} channels made of measured ones, expected errors {min(errors.values()):.1%} to "
                f"{errors[worst]:.1%} ({worst})"
            )
    return lines


def _planned(field: Field, sensors: Sequence[str | Path], format: str, delta: bool) -> list[Simulated]:
    if format not in FORMATS:
        raise InputError(f"simulate: format is {format!r}, expected one of {', '.join(FORMATS)}.")
    if not sensors:
        raise InputError("simulate: no sensor, expected at least one file.")
    planned = [plan_sensor(field, find_sensor_file(str(s)), delta) for s in sensors]
    names = [p.sensor.name for p in planned]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"simulate: two sensors are called '{name}', expected every name once.")
    for p in planned:
        if format == "dng" and (p.sensor.mosaic is None or not is_bayer(p.sensor.mosaic) or len(p.sensor.channels) != 3):
            raise InputError(f"{p.file.name}: DNG holds 2x2 Bayer mosaics of red, green and blue, expected --format png or tiff.")
        if format == "png" and p.sensor.mosaic is None and p.sensor.channel_count not in (1, 3):
            raise InputError(f"{p.file.name}: {p.sensor.channel_count} channels at every pixel do not fit a PNG, expected --format tiff.")
    return planned


def _write(
    field: Field,
    planned: Sequence[Simulated],
    requests: Sequence[tuple[Simulated, Camera, np.ndarray, str]],
    out: Path,
    seed: int,
    format: str,
    share: Share,
    progress: Progress | None,
) -> Path | None:
    known = field_hash(field)
    frames: list[tuple[Simulated, int, Camera, np.ndarray]] = []
    for p in planned:
        own = [(camera, pose, name) for q, camera, pose, name in requests if q is p]
        frames += [(p, i, camera, pose) for i, (camera, pose, _) in zip(_ids([name for _, _, name in own]), own, strict=True)]
    listing = {
        p.sensor.name: {i: PosedCamera(camera, pose, f"{i:04d}.{format}") for q, i, camera, pose in frames if q is p} for p in planned
    }
    content = meta_content(out, [p.sensor for p in planned], listing, field.region, field.unit)
    (out / "meta_data.json").unlink(missing_ok=True)  # it must not vouch for frames of another request
    for p in planned:
        write_text(out / "sensors" / f"{p.sensor.name}.toml", sensor_to_toml(p.file))
    mine = share.of(len(frames))
    count = Counter(progress, sum(p.supersampling**2 * camera.width * camera.height for p, _, camera, _ in (frames[k] for k in mine)))
    complete = True
    for k, (p, i, camera, pose) in enumerate(frames):
        name = p.sensor.name
        path, sidecar = out / "modalities" / name / f"{i:04d}.{format}", out / "sidecars" / name / f"{i:04d}.json"
        facts = _facts(p, camera, pose, i, seed, known)
        finished = _finished(sidecar, facts, path)
        if k not in mine:
            complete &= finished
            continue
        goal = count.done + p.supersampling**2 * camera.width * camera.height
        if not finished:
            sidecar.unlink(missing_ok=True)
            _write_frame(path, simulate_frame(field, p, camera, pose, i, seed, count), p)
            write_json(sidecar, {**facts, "file": f"modalities/{name}/{path.name}", "sha256": sha256_of(path)})
        count(goal - count.done)
    if not complete:
        return None
    write_json(out / "meta_data.json", content)
    return out / "meta_data.json"


def _ids(names: Sequence[str]) -> list[int]:
    numbers = [int(name) for name in names if name.isdecimal()]
    return numbers if len(numbers) == len(names) == len(set(numbers)) else list(range(len(names)))


def _facts(planned: Simulated, camera: Camera, pose: np.ndarray, frame: int, seed: int, known: str) -> dict[str, Any]:
    return {
        "sensor": json.loads(planned.file.model_dump_json(exclude_defaults=True)),
        "kind": planned.file.kind,
        "frame": frame,
        "seed": seed,
        "supersampling": planned.supersampling,
        "stages": list(STAGES),
        "in_the_field": list(IN_THE_FIELD) if planned.file.kind == "instance" else [],
        "analysers": "of the file" if planned.polarized else "of the field" if planned.sensor.is_polarization else None,
        "channels_made_of": {
            label: {"residual": c.residual, "noise_gain": c.noise_gain, "weights": c.weights.tolist()}
            for label, c in planned.combinations.items()
        },
        "camera": posed_to_json(PosedCamera(camera, pose)),
        "conventions": {key: CONVENTIONS[key] for key in ("camera_axes", "pixels", "distortion", "world")},
        "field": known,
        "versions": {"mmsynth": __version__} | {package: version(package) for package in ("numpy", "torch")},
    }


def _finished(sidecar: Path, facts: dict[str, Any], path: Path) -> bool:
    try:
        stated = read_json(sidecar)
    except InputError:
        return False
    same = isinstance(stated, dict) and all(stated.get(k) == v for k, v in json.loads(json.dumps(facts)).items())
    return same and path.is_file() and sha256_of(path) == stated.get("sha256")


def _write_frame(path: Path, numbers: np.ndarray, planned: Simulated) -> None:
    file = planned.file
    stored = (numbers << file.shift).astype(np.uint8 if file.file_bits == 8 else np.uint16)
    if path.suffix == ".dng":
        assert planned.sensor.mosaic is not None
        black, white = (round(x * 2**file.shift) for x in (file.noise.black_dn, file.noise.white_dn))
        write_dng(path, stored.astype(np.uint16), planned.sensor.mosaic, black, white, f"mmsynth {file.name}")
    elif path.suffix == ".tiff":
        write_tiff(path, stored)
    else:
        write_png(path, stored)
