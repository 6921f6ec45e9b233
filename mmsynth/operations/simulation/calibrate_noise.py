"""A sensor's noise figures without a laboratory: from the frames of a scene and the field that was fitted to them, or from frames alone.

A field averages over many frames: it gives the expected value of a photosite, and how smooth the picture is there. Differences between
neighbouring photosites beyond that are noise. How their variance grows with light gives gain, read noise and PRNU
(``photon_transfer.photon_transfer_of_frames``).

Without a field, the expectation is a blurred copy of the frame: good enough where a picture is smooth over some photosites.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from mmsynth.errors import InputError
from mmsynth.files import write_atomic, write_json, write_text
from mmsynth.operations.output.progress import Counter, Progress
from mmsynth.scene.images import read_native, used_bits
from mmsynth.scene.scene import Frame, Scene, Sensor, canonical_modality
from mmsynth.sensors.filters import gaussian_mean
from mmsynth.sensors.mosaic import channel_map, crop_pattern, photosites_of
from mmsynth.sensors.noise import NoiseModel
from mmsynth.sensors.photon_transfer import UNCLIPPED, PhotonTransfer, photon_transfer_of_frames
from mmsynth.sensors.sensor_file import SensorFile, sensor_to_toml

if TYPE_CHECKING:
    from mmsynth.field.field import Field

_RAYS = 4_000_000  # to render for each sensor
_LEAST_LIT = 16  # pixels, to measure an exposure
_EXPLAINED = 0.75  # of a frame's variance, from which a field knows what it shows: one that was fitted explains 0.95 and more
_BLUR = 1.5  # of a frame that is its own expectation, in tiles of the mosaic


@dataclasses.dataclass(frozen=True)
class Calibrated:
    """A sensor file with the figures found, the figures with their deviations, and what they are from.

    Attributes:
        frames: how many. exposure: of each, in units of what the field learned; frames alone have none.
    """

    file: SensorFile
    found: PhotonTransfer
    frames: int
    exposure: tuple[float, ...] = ()

    def to_json(self) -> dict[str, Any]:
        p, noise = self.found, self.file.noise
        share = p.gain_sd / p.gain_dn_e
        return {
            "frames": self.frames, "exposure": list(self.exposure), "bits": noise.bits, "black_dn": noise.black_dn,
            "gain_dn_e": p.gain_dn_e, "gain_sd": p.gain_sd,
            "full_scale_e": noise.electrons_at_one, "full_scale_sd": noise.electrons_at_one * share,
            "read_e": p.read_e, "read_sd": p.read_sd, "prnu": p.prnu, "prnu_sd": p.prnu_sd,
            "mean_dn": p.mean_dn.tolist(), "variance_dn2": p.variance_dn2.tolist(),
        }  # fmt: skip

    def comments(self) -> tuple[str, ...]:
        """For the head of the file: what is known how well."""
        p, noise = self.found, self.file.noise
        below = lambda sd, unit: "not told" if sd >= 100 else f"not told, below about {sd:.2g} {unit}"
        at_most = lambda value, sd, unit: f"{value:.3g} ± {sd:.2g} {unit}" if value > 0 else below(sd, unit)
        return (
            f"noise: photon transfer of {self.frames} frames (mmsynth calibrate-noise), with one standard deviation:",
            f"gain {p.gain_dn_e:.4g} ± {p.gain_sd:.2g} DN/e-, full scale {noise.electrons_at_one:.0f} e-",
            f"read noise {at_most(p.read_e, p.read_sd, 'e-')}; PRNU {at_most(100 * p.prnu, 100 * p.prnu_sd, '%')}",
            "full_well_e is the full scale of the converter: a pixel may hold more",
        )


def calibrate_noise(
    field: Field,
    scene: Scene,
    *,
    modalities: Sequence[str] | None = None,
    known: Mapping[str, SensorFile] | None = None,
    raw: Path | None = None,
    views: Sequence[int] | None = None,
    out: Path | None = None,
    progress: Progress | None = None,
) -> tuple[dict[str, Calibrated], dict[str, str]]:
    """Noise figures of the sensors of a scene, from its frames and the field.

    The exposure of each frame is measured against the field. Read noise needs frames of short exposure.

    Args:
        modalities: None: all. known: sensor files by modality, whose bits, black level and alignment are believed; without, bits are
            those that the frames use, and black is 0. raw: a folder with other frames of the same poses, of any exposure,
            ``raw/MODALITY/0009.png``.
        views: of which frames; None: the training views, or all that ``raw`` has.
        out: folder for the sensor files (``write``). progress: called with (rays done, rays in all).
    Returns:
        the figures by modality; and, of modalities whose frames tell nothing (see ``photon_transfer_of_frames``) or whose frames the
        field does not explain, a sentence that says why.
    Raises:
        InputError: unknown modality, or no frames of one.
    """
    names = field.check_modalities(field.measured if modalities is None else [canonical_modality(m) for m in modalities])
    for name in names:
        if name in field.predicted:
            others = ", ".join(field.measured)
            raise InputError(f"calibrate-noise: {name} is predicted by a prior, no sensor measured it; expected one of {others}.")
    chosen = {name: _frames(scene, name, raw, views) for name in names}
    count = Counter(progress, sum(f.camera.width * f.camera.height for frames in chosen.values() for f, _ in frames))
    calibrated, failed = {}, {}
    for name, frames in chosen.items():
        sensor = field.sensors[name]
        file = (known or {}).get(name) or _assumed(sensor, frames[0][1])
        pairs = []
        for frame, path in frames:
            rendered = field.render(frame.camera, field.pose_of(frame), [name], geometry=False, progress=count).channels[name]
            pairs.append((_numbers(path, file), rendered.astype(np.float64) * file.dn_at_one))
        try:
            calibrated[name] = _calibrated(sensor, file, pairs)
        except InputError as error:
            failed[name] = str(error)
    if out is not None and calibrated:
        write(calibrated, out)
    return calibrated, failed


def calibrate_from_frames(file: SensorFile, paths: Sequence[Path]) -> Calibrated:
    """Noise figures of a sensor from its raw frames alone. The frames must show smooth surfaces, bright and dark.

    Args:
        file: gives bits, black level, alignment and mosaic.
    Raises:
        InputError: no frames, frames with all channels at every pixel, or frames that tell nothing.
    """
    if not paths:
        raise InputError(f"{file.name}: no frames, expected at least one image file.")
    pattern = _tile(None if file.mosaic is None else crop_pattern(np.array(file.mosaic), file.mosaic_offset))
    pairs = []
    for path in paths:
        numbers = _numbers(path, file)
        if numbers.ndim != 2:
            raise InputError(f"{path}: {numbers.shape[2]} channels, expected a raw frame of one.")
        pairs.append((numbers, _blurred(numbers, pattern)))
    transfer = _fit(file.name, file, pairs, pattern)
    return Calibrated(_calibrated_file(file, transfer), transfer, len(paths))


def _frames(scene: Scene, name: str, raw: Path | None, views: Sequence[int] | None) -> list[tuple[Frame, Path]]:
    """Frames and the files to read for them, at most as many as ``_RAYS`` allows, evenly spread."""
    wanted = tuple(views) if views is not None else (None if raw is not None else scene.split.train)
    found = []
    for frame in scene.frames_of(name, wanted):
        path = frame.path
        if raw is not None:
            places = [raw / folder / f"{frame.view:04d}.png" for folder in dict.fromkeys((frame.source_name, name))]
            path = next((place for place in places if place.is_file()), places[0])
            if not path.is_file():
                continue
        found.append((frame, path))
    if not found:
        raise InputError(f"{raw or scene.root}: no frames of {name} to calibrate from.")
    pixels = found[0][0].camera.width * found[0][0].camera.height
    most = max(1, _RAYS // pixels)
    return found if len(found) <= most else [found[(2 * i + 1) * len(found) // (2 * most)] for i in range(most)]


def _assumed(sensor: Sensor, path: Path) -> SensorFile:
    """What a sensor's files say by themselves."""
    pixels = read_native(path)
    if pixels.dtype.kind != "u":
        raise InputError(f"{path}: pixels of type {pixels.dtype}, expected the integers of a converter.")
    bits = 8 if pixels.dtype == np.uint8 else used_bits(pixels)
    return SensorFile.model_validate({"name": sensor.name, "instance_of": sensor.name, "noise": NoiseModel(bits, 1.0, 1.0)})


def _numbers(path: Path, file: SensorFile) -> np.ndarray:
    """DN as the converter gave them."""
    pixels = read_native(path)
    wanted = np.uint8 if file.file_bits == 8 else np.uint16
    if pixels.dtype != wanted:
        raise InputError(
            f"{path}: pixels of type {pixels.dtype}, expected {np.dtype(wanted)} for the {file.noise.bits} bits of {file.name}."
        )
    if file.shift and (pixels & (2**file.shift - 1)).any():
        raise InputError(
            f"{path}: its low {file.shift} bits are in use, expected {file.noise.bits} bits moved up; check bits and alignment."
        )
    if int(pixels.max()) >> file.shift > file.noise.white_dn:
        raise InputError(f"{path}: a pixel is {int(pixels.max())}, expected at most {file.noise.white_dn:g}; check bits and alignment.")
    return pixels >> file.shift


def _tile(pattern: np.ndarray | None) -> np.ndarray:
    return np.zeros((1, 1), np.int64) if pattern is None else pattern


def _calibrated(sensor: Sensor, file: SensorFile, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Calibrated:
    """From raw frames and what the field says of them [DN]."""
    pattern = _tile(sensor.mosaic)
    if pairs[0][0].ndim == 3:  # every channel at every pixel: each is a frame of its own, of one converter
        split = [(raw[..., c], expected[..., c : c + 1]) for raw, expected in pairs for c in range(raw.shape[-1])]
        pattern = _tile(None)
    else:
        split = list(pairs)
    exposed = [_exposed(raw, expected, pattern, file.noise.black_dn, file.noise.white_dn) for raw, expected in split]
    explained = float(np.median([share for _, share, _ in exposed]))
    if explained < _EXPLAINED:
        raise InputError(
            f"{sensor.name}: the field explains {max(explained, 0.0):.0%} of what these frames show, expected at least {_EXPLAINED:.0%}; "
            "fit it longer, or give frames of a longer exposure."
        )
    transfer = _fit(sensor.name, file, [(raw, expected) for (raw, _), (_, _, expected) in zip(split, exposed, strict=True)], pattern)
    exposure = np.reshape([e for e, _, _ in exposed], (len(pairs), -1)).mean(1)
    return Calibrated(_calibrated_file(file, transfer), transfer, len(pairs), tuple(exposure.tolist()))


def _exposed(raw: np.ndarray, expected: np.ndarray, pattern: np.ndarray, black: float, white: float) -> tuple[float, float, np.ndarray]:
    """Exposure of a frame (H, W) in units of the expectation's (H, W, C); the share of its variance that this explains; the expectation at
    that exposure. The exposure is the light of the brighter half in all, less what nobody expected.

    Of the ways to measure it (``guidance`` and ``register`` take medians) this one is the surest: of 16,000 photosites of a frame of 1/64
    of the light it errs by 0.35 % (medians: 0.5 %), by less than 0.01 % when a third of them show something else (medians: 0.4 to 0.9 %).
    """
    everywhere = photosites_of(expected, pattern) - black
    good = np.isfinite(everywhere) & (raw < UNCLIPPED * white)
    light, seen = everywhere[good], raw[good] - black
    bright = light > max(float(np.median(light)), 0.0) if len(light) else good[good]
    if bright.sum() < _LEAST_LIT:
        return 1.0, 1.0, expected
    near = bright
    for _ in range(4):
        exposure = max(float(seen[near].sum() / light[near].sum()), 1e-6)
        off = np.abs(seen - exposure * light)
        near = bright & (off <= 4.0 * np.median(off[bright]))
    explained = 1.0 - float(np.mean((seen - exposure * light) ** 2) / max(float(seen.var()), 1e-12))
    return exposure, explained, black + exposure * (expected - black)


def _fit(name: str, file: SensorFile, pairs: Sequence[tuple[np.ndarray, np.ndarray]], pattern: np.ndarray) -> PhotonTransfer:
    try:
        return photon_transfer_of_frames(pairs, pattern, file.noise.bits, file.noise.black_dn)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def _calibrated_file(file: SensorFile, transfer: PhotonTransfer) -> SensorFile:
    noise = file.noise
    changed = dataclasses.replace(
        noise,
        gain_dn_e=round(transfer.gain_dn_e, 6),
        full_well_e=round((noise.white_dn - noise.black_dn) / transfer.gain_dn_e, 1),
        read_e=round(transfer.read_e, 3),
        prnu=round(transfer.prnu, 5),
    )
    return file.model_copy(update={"noise": changed})


def _blurred(raw: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """(H, W, C): every channel at every pixel, a Gaussian mean of its own photosites."""
    rows, columns = pattern.shape
    measured = channel_map(pattern, *raw.shape)
    out = []
    for channel in range(int(pattern.max()) + 1):
        here = (measured == channel).astype(np.float64)
        smooth = lambda image: gaussian_mean(image, (_BLUR * rows, _BLUR * columns))
        out.append(smooth(raw * here) / smooth(here))
    return np.stack(out, -1)


def by_modality(files: Sequence[SensorFile]) -> dict[str, SensorFile]:
    """Files of captured sensors by the modality that they are of.

    Raises:
        InputError: a virtual one, or two of one modality.
    """
    out: dict[str, SensorFile] = {}
    for file in files:
        name = canonical_modality(file.instance_of or "")
        if not name or name in out:
            raise InputError(f"sensor {file.name}: expected one file for each captured sensor (key 'instance_of').")
        out[name] = file
    return out


def write(calibrated: Mapping[str, Calibrated], out: Path) -> None:
    """``NAME.toml`` for each sensor, ``noise.svg`` and ``noise.json``."""
    for name, c in calibrated.items():
        write_text(out / f"{name}.toml", sensor_to_toml(c.file, c.comments()))
    write_atomic(out / "noise.svg", lambda path: FigureCanvasSVG(noise_figure(calibrated)).print_svg(path, metadata={"Date": None}))
    write_json(out / "noise.json", {name: c.to_json() for name, c in calibrated.items()})


def noise_figure(calibrated: Mapping[str, Calibrated]) -> Figure:
    """Photon transfer curves: measured variances over mean, and the fitted ones; a panel per sensor."""
    figure = Figure(figsize=(4.2 * len(calibrated), 3.6), layout="constrained")
    for axes, (name, c) in zip(np.ravel(figure.subplots(1, len(calibrated), squeeze=False)), calibrated.items(), strict=True):
        p, noise = c.found, c.file.noise
        signal = np.maximum(p.mean_dn - noise.black_dn, 1e-3)
        axes.scatter(signal, p.variance_dn2, s=12, color="#444", label="plain surfaces")
        line = np.geomspace(signal.min(), noise.white_dn - noise.black_dn, 100) if len(signal) else np.array([1.0, noise.white_dn])
        k = p.gain_dn_e
        axes.plot(line, (k * p.read_e) ** 2 + 1 / 12 + k * line + (p.prnu * line) ** 2, color="C0", label=f"K = {k:.3g} DN/e-")
        axes.set(xscale="log", yscale="log", xlabel="mean above black [DN]", ylabel="variance [DN²]", title=name)
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8)
    return figure
