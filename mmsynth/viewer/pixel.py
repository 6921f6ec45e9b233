"""Ask a pixel: what the field knows of one ray, and which training pixels saw the point."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field as of_dataclass

import numpy as np
import torch

from mmsynth.field.field import Field
from mmsynth.operations.output import previews
from mmsynth.operations.views.visibility import SAME_SURFACE, inside
from mmsynth.report.page import svg
from mmsynth.scene.scene import Frame, Scene
from mmsynth.sensors.camera import project
from mmsynth.sensors.polarization import angle_of_linear_polarization, degree_of_linear_polarization

_CROP = 12  # pixels on each side
_SHOWN = 4  # crops of a modality


@dataclass(frozen=True)
class Band:
    """One channel at a pixel: light, 1.0 = full scale, and its standard deviation where it was predicted."""

    modality: str
    channel: str
    nm: float | None
    light: float
    deviation: float | None = None


@dataclass(frozen=True)
class Sighting:
    """A training frame that saw a point: where in its pixels (u, v), and from how far away, scene unit."""

    frame: Frame
    pixel: tuple[float, float]
    distance: float


@dataclass(frozen=True)
class Answer:
    """What a field shows along one ray.

    Attributes:
        bands: of all modalities but polarization, and S0 of that. stokes: (S0, S1, S2) of polarization modalities, about the x axis of
            the camera that asked. point, normal: (3,) in the scene's frame, None where nothing is met. depth: along the ray, scene unit.
        specular: share of the light that is images of lamps, by modality, where surfaces mirror any. sightings: see ``sightings_of``.
    """

    bands: list[Band]
    stokes: dict[str, np.ndarray]
    opacity: float
    point: np.ndarray | None
    normal: np.ndarray | None
    depth: float | None
    specular: dict[str, float] = of_dataclass(default_factory=dict)
    sightings: list[Sighting] = of_dataclass(default_factory=list)


def ask(field: Field, camera_to_world: np.ndarray, direction: np.ndarray, scene: Scene | None = None) -> Answer:
    """What a camera (4, 4) sees along a unit direction (3,) in its axes; scene: whose training frames are asked, too."""
    seen = field.cast(np.asarray(direction, dtype=np.float64)[None], camera_to_world, list(field.sensors), True, True)
    bands: list[Band] = []
    stokes: dict[str, np.ndarray] = {}
    for name, sensor in field.sensors.items():
        deviation = seen.get(f"deviation/{name}")
        if sensor.is_polarization:
            stokes[name] = seen[f"stokes/{name}"][0]
            unsure = None if deviation is None else float(np.sqrt(2.0) * deviation[0].mean())  # S0 is twice the mean of the analysers
            bands.append(Band(name, "S0", None, float(stokes[name][0]), unsure))
            continue
        for i, (label, nm) in enumerate(zip(sensor.channels, sensor.wavelengths_nm, strict=True)):
            bands.append(Band(name, label, nm, float(seen[name][0, i]), None if deviation is None else float(deviation[0, i])))
    specular = {
        name: float(seen[f"mirrored/{name}"][0].sum() / max(seen[name][0].sum(), 1e-12))
        for name in field.sensors
        if f"mirrored/{name}" in seen
    }
    depth = float(seen["depth"][0])
    if not np.isfinite(depth):
        return Answer(bands, stokes, float(seen["opacity"][0]), None, None, None, specular)
    depth *= field.region.radius
    point = camera_to_world[:3, 3] + depth * (camera_to_world[:3, :3] @ direction)
    normal = seen["normal"][0]
    sightings = [] if scene is None else sightings_of(field, scene, point)
    return Answer(
        bands, stokes, float(seen["opacity"][0]), point, normal if np.isfinite(normal).all() else None, depth, specular, sightings
    )


def sightings_of(field: Field, scene: Scene, point: np.ndarray) -> list[Sighting]:
    """Training frames that see a point (3,) of the scene with nothing before it, the nearest first."""
    frames = [frame for frame in scene.frames if frame.view in scene.split.train]
    found = []
    for frame in frames:
        pose = field.pose_of(frame)
        local = pose[:3, :3].T @ (point - pose[:3, 3])
        pixel = project(local[None], frame.camera)
        if inside(pixel, frame.camera)[0]:
            found.append((frame, pixel[0], pose))
    if not found:
        return []
    centres = np.stack([pose[:3, 3] for *_, pose in found])
    away = point - centres
    distance = np.linalg.norm(away, axis=1)
    met = field.render_rays(
        field.to_normalised(centres),
        torch.from_numpy((away / distance[:, None]).astype(np.float32)).to(field.device),
        torch.from_numpy(np.stack([pose[:3, 0] for *_, pose in found]).astype(np.float32)).to(field.device),
        [],
        geometry=False,
    )
    depth = met["depth"].cpu().numpy() * field.region.radius
    clear = ~(depth < (1.0 - SAME_SURFACE) * distance)
    order = [i for i in np.argsort(distance) if clear[i]]
    return [Sighting(found[i][0], (float(found[i][1][0]), float(found[i][1][1])), float(distance[i])) for i in order]


# ------------------------------------------------------------------------------------------------------------------------- as a page


def answer_html(field: Field, answer: Answer, pixels_of: Callable[[Frame], np.ndarray] | None, coverage: float | None = None) -> str:
    """The answer as HTML: plots, a table of numbers, crops of the frames that saw the point.

    Args:
        pixels_of: a frame's preview (H, W, 3) uint8; None: no crops.
    """
    parts = []
    if answer.point is None:
        parts.append("<p>Nothing is met along this ray.</p>")
    parts.append(_plots(field, answer))
    parts.append(_numbers(field, answer, coverage))
    if pixels_of is not None:
        parts.append(_crops(answer, pixels_of))
    return f'<div class="mmsynth-pixel" style="padding:0 .8em;font-size:.8em">{"".join(parts)}</div>'


def _plots(field: Field, answer: Answer) -> str:
    """Channels without a wavelength as bars, those with one as spectra, polarization as ellipses; an SVG."""
    from matplotlib.figure import Figure  # a second to import: a viewer opens without
    from matplotlib.patches import Ellipse

    rest, waves = ([band for band in answer.bands if (band.nm is None) == alone] for alone in (True, False))
    figure = Figure(figsize=(3.7, 1.9 * bool(rest or waves) + 1.3 * bool(answer.stokes)), layout="constrained")
    rows = figure.subfigures(1 + bool(answer.stokes), 1, height_ratios=[1.9, 1.3][: 1 + bool(answer.stokes)], squeeze=False)[:, 0]
    shares = [0.16 * len(rest) + 0.2, 1.6]
    panels = rows[0].subplots(1, 2, sharey=True, width_ratios=shares) if rest and waves else [rows[0].subplots()] * 2
    if rest:
        labels = [f"{band.modality} {band.channel}" if band.channel != band.modality else band.modality for band in rest]
        sd = [band.deviation or 0.0 for band in rest]
        colours = ["C1" if band.modality in field.predicted else "0.6" for band in rest]
        panels[0].bar(range(len(rest)), [band.light for band in rest], yerr=sd, color=colours, error_kw={"lw": 0.8})
        panels[0].set_xticks(range(len(rest)), labels, rotation=90)
    for name in dict.fromkeys(band.modality for band in waves):
        own = sorted((band for band in waves if band.modality == name), key=lambda band: band.nm or 0.0)
        nm, light = np.array([band.nm for band in own]), np.array([band.light for band in own])
        predicted = name in field.predicted
        (line,) = panels[1].plot(nm, light, "o--" if predicted else "o-", ms=3, label=f"{name}, predicted" if predicted else name)
        if predicted:
            unsure = np.array([band.deviation for band in own], dtype=float)
            panels[1].fill_between(nm, light - unsure, light + unsure, color=line.get_color(), alpha=0.25, lw=0)
    if waves:
        panels[1].set_xlabel("wavelength [nm]", fontsize=7)
        panels[1].legend(frameon=False, fontsize=6)
    panels[0].set_ylabel("light [full scale]", fontsize=7)
    for axes in panels:
        axes.set_ylim(bottom=min(0.0, *(band.light for band in answer.bands)))
        axes.tick_params(labelsize=6)
        axes.grid(alpha=0.25)
    if answer.stokes:
        below = rows[1].subplots()
        for i, (name, stokes) in enumerate(answer.stokes.items()):
            dolp, aolp = _dolp_aolp(stokes)
            # behind a turned analyser: 1 + DoLP along AoLP, 1 - DoLP across
            below.add_patch(Ellipse((3.0 * i, 0), 1.0 + dolp, 1.0 - dolp, angle=aolp, fill=False, color="C3"))
            below.annotate(f"{name}: DoLP {dolp:.3f}, AoLP {aolp:.1f}°", (3.0 * i, -1.3), fontsize=6.5, ha="center")
        below.set(xlim=(-1.5, 3.0 * len(answer.stokes) - 1.5), ylim=(-1.5, 0.9), aspect="equal", xticks=[], yticks=[])
        below.axhline(0, lw=0.4, color="0.7")
        below.set_frame_on(False)
    return f'<div role="img" aria-label="spectrum and polarization of the pixel">{svg(figure)}</div>'


def _dolp_aolp(stokes: np.ndarray) -> tuple[float, float]:
    """DoLP and AoLP [degrees]."""
    tensor = torch.from_numpy(stokes.astype(np.float64))
    return float(degree_of_linear_polarization(tensor)), float(angle_of_linear_polarization(tensor))


def _numbers(field: Field, answer: Answer, coverage: float | None) -> str:
    unit = html.escape(field.unit)
    rows = []
    for band in answer.bands:
        star = "*" if band.modality in field.predicted else ""
        sd = "" if band.deviation is None else f"± {band.deviation:.4f}"
        label = band.channel if band.channel.startswith(band.modality) else f"{band.modality} {band.channel}"
        rows.append((f"{label}{star}", f"{band.light:.4f} {sd}", "" if band.nm is None else f"{band.nm:g} nm"))
    for name, vector in answer.stokes.items():
        dolp, aolp = _dolp_aolp(vector)
        rows.append((f"{name} S1, S2", ", ".join(f"{v:.4f}" for v in vector[1:]), f"DoLP {dolp:.3f}, AoLP {aolp:.1f}°"))
    for name, share in answer.specular.items():
        if share >= 0.005:
            rows.append((f"{name} specular", f"{share:.1%}", "of the light"))
    rows.append(("opacity", f"{answer.opacity:.3f}", ""))
    if answer.depth is not None and answer.point is not None:
        rows.append(("depth", f"{answer.depth:.5g} {unit}", ""))
        rows.append(("point", ", ".join(f"{v:.5g}" for v in answer.point), unit))
    if answer.normal is not None:
        rows.append(("normal", ", ".join(f"{v:.3f}" for v in answer.normal), ""))
    if coverage is not None:
        rows.append(("coverage", f"{coverage:.3f}", ""))
    body = "".join(
        f"<tr><td>{html.escape(a)}</td><td class='value'>{html.escape(b)}</td><td>{html.escape(c)}</td></tr>" for a, b, c in rows
    )
    note = "<p>*: predicted by a prior, not measured; ± one standard deviation</p>" if field.predicted else ""
    return f"<table>{body}</table>{note}"


def _crops(answer: Answer, pixels_of: Callable[[Frame], np.ndarray]) -> str:
    if answer.point is None:
        return ""
    if not answer.sightings:
        return "<p>No training frame saw this point.</p>"
    parts = [f"<p>{len(answer.sightings)} training frames saw this point; the nearest:</p>"]
    for name in dict.fromkeys(sighting.frame.sensor for sighting in answer.sightings):
        own = [s for s in answer.sightings if s.frame.sensor == name]
        parts.append(f"<div>{html.escape(name)} ({len(own)})<br>")
        for sighting in own[:_SHOWN]:
            source = base64.b64encode(previews.encode_png(crop(pixels_of(sighting.frame), sighting.pixel))).decode()
            label = f"{name}, view {sighting.frame.view}, pixel {sighting.pixel[0]:.0f}, {sighting.pixel[1]:.0f}"
            parts.append(
                f'<img src="data:image/png;base64,{source}" alt="{html.escape(label)}" title="{html.escape(label)}" '
                'style="width:64px;height:64px;image-rendering:pixelated;margin:1px">'
            )
        parts.append("</div>")
    return "".join(parts)


def crop(picture: np.ndarray, pixel: tuple[float, float]) -> np.ndarray:
    """(25, 25, 3) uint8 around a pixel, which is framed in white; black beyond the picture."""
    u, v = round(pixel[0]), round(pixel[1])
    padded = np.pad(picture, ((_CROP, _CROP), (_CROP, _CROP), (0, 0)))
    out = padded[v : v + 2 * _CROP + 1, u : u + 2 * _CROP + 1].copy()
    out[_CROP - 2 : _CROP + 3, [_CROP - 2, _CROP + 2]] = 255
    out[[_CROP - 2, _CROP + 2], _CROP - 2 : _CROP + 3] = 255
    return out
