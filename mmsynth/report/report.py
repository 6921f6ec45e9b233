"""One self-contained HTML page per run: decisions, curve, test views, scores. No script, no network, no other file."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.figure import Figure

from mmsynth.errors import InputError
from mmsynth.fitting.choices import choices_of
from mmsynth.operations.output import previews
from mmsynth.report.page import svg, write_page
from mmsynth.scene.images import load_frame
from mmsynth.scene.preview_colours import preview_colours_of
from mmsynth.scene.scene import Frame, Scene, Sensor
from mmsynth.sensors.mosaic import channels_of, demosaic_edge_aware, is_bayer
from mmsynth.sensors.polarization import intensities_to_stokes

if TYPE_CHECKING:
    from mmsynth.field.field import Field

# what each score means to a reader: label, decimals
_COLUMNS = {
    "psnr": ("PSNR [dB]", 2),
    "psnr_view_mean": ("PSNR, mean of dB over views", 2),
    "psnr_foreground": ("PSNR foreground, pooled [dB]", 2),
    "psnr_foreground_view_mean": ("PSNR foreground, mean of dB over views", 2),
    "foreground_from": ("foreground from", 0),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
    "psnr_truth": ("PSNR against truth [dB]", 2),
    "psnr_aligned": ("PSNR aligned [dB]", 2),
    "psnr_aligned_free_gain": ("aligned, free gain [dB]", 2),
    "within_2sd": ("within 2 deviations", 3),
    "psnr_highlights": ("highlights [dB]", 2),
    "psnr_silhouettes": ("silhouettes [dB]", 2),
    "psnr_rest": ("the rest [dB]", 2),
    "sam": ("spectral angle [°]", 2),
    "stokes_rmse": ("Stokes RMSE", 4),
    "dolp_rmse": ("DoLP RMSE", 4),
    "aolp_mae": ("AoLP error [°]", 2),
}

_BODY = """\
<p class="note">{{ subtitle }}</p>
{% if scores %}<h2>Scores on the test views</h2>
<div class="scroll"><table><tr><th>modality</th>{% for c in columns %}<th>{{ c }}</th>{% endfor %}</tr>
{% for name, row in scores %}<tr><td>{{ name }}</td>{% for v in row %}<td class="number">{{ v }}</td>{% endfor %}</tr>
{% endfor %}</table></div>
<p class="note">{{ score_note }}</p>{% endif %}
{% if rows %}<h2>{{ pictures_title }}</h2>
{% for row in rows %}<div>{% for caption, source in row %}<figure><img src="{{ source }}" alt="{{ caption }}">
<figcaption>{{ caption }}</figcaption></figure>{% endfor %}</div>
{% endfor %}
<p class="note">Previews are tone-mapped, the frame and its rendering with one exposure; frames are demosaicked for display
only.</p>{% endif %}
{% if curve %}<h2>The fit</h2>{{ curve | safe }}{% endif %}
{% for heading, lines in tables if lines %}<h2>{{ heading }}</h2>
<table>{% for k, v in lines %}<tr><td>{{ k }}</td><td>{{ v }}</td></tr>{% endfor %}</table>
{% endfor %}"""


def read_log(path: Path) -> list[dict[str, Any]]:
    """``train.jsonl`` → its entries; a missing file is an empty log, and a last line cut off by a crash is dropped."""
    if not Path(path).is_file():
        return []
    entries = []
    for line in Path(path).read_text(encoding="utf-8").splitlines():
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(entry, dict):
            entries.append(entry)
    return entries


def curve_svg(log: Sequence[Mapping[str, Any]]) -> str:
    """Loss and PSNR per modality over seconds, as an SVG element; "" for an empty log.

    An entry holds step, elapsed [s], loss and psnr (modality → dB, of the training rays).
    """
    if not log:
        return ""
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    seconds = np.array([entry.get("elapsed", entry.get("step", i)) for i, entry in enumerate(log)], float)
    left.plot(seconds, [_number(entry.get("loss")) for entry in log], color="#444")
    left.set(xlabel="seconds", ylabel="loss")
    if any(_number(entry.get("loss")) > 0 for entry in log):
        left.set_yscale("log")
    names = list(dict.fromkeys(name for entry in log for name in entry.get("psnr", {})))
    for name in names:
        right.plot(seconds, [_number(entry.get("psnr", {}).get(name)) for entry in log], label=name)
    right.set(xlabel="seconds", ylabel="PSNR of the training rays [dB]")
    if names:
        right.legend(frameon=False)
    for axes in (left, right):
        axes.grid(alpha=0.25)
    return svg(figure)


def _number(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else float("nan")


def _source(image: np.ndarray) -> str:
    """Display image → data URI."""
    return "data:image/png;base64," + base64.b64encode(previews.encode_png(image)).decode("ascii")


def measured_channels(sensor: Sensor, frame: Frame) -> np.ndarray:
    """A frame with all channels at every pixel (H, W, C), demosaicked for display; times its alpha, as it is fitted and scored."""
    pixels, alpha = load_frame(sensor, frame)
    if alpha is not None:
        pixels = pixels * alpha[..., None]
    if sensor.mosaic is not None and is_bayer(sensor.mosaic):
        return np.moveaxis(demosaic_edge_aware(pixels, sensor.mosaic), 0, -1)
    return channels_of(pixels, sensor.mosaic)


def picture_rows(field: Field, scene: Scene) -> tuple[int | None, list[list[tuple[str, np.ndarray]]]]:
    """Per modality (caption, display image): frame | rendering | difference, for polarization also AoLP and DoLP; last depth and normals.

    Returns:
        the id of the first test view (None: no frame) and the rows.
    """
    names = [name for name in field.measured if name in scene.sensors]
    frames = {name: (scene.frames_of(name, scene.split.test) or scene.frames_of(name))[:1] for name in names}
    rows: list[list[tuple[str, np.ndarray]]] = []
    geometry: list[tuple[str, np.ndarray]] = []
    view: int | None = None
    for name in names:
        for frame in frames[name]:
            sensor = field.sensors[name]
            first = view is None
            view = frame.view if view is None else view
            measured = measured_channels(scene.sensors[name], frame)
            rendering = field.render(frame.camera, field.pose_of(frame), [name], geometry=first)
            ours = rendering.channels[name]
            colours = preview_colours_of(scene.sensors[name], scene.frames_of(name))
            linear = previews.preview_linear(sensor, measured, colours)
            exposure = previews.exposure_of(linear)
            difference = np.abs(np.nan_to_num(ours) - measured).mean(-1) * rendering.valid
            row = [
                (f"{name}: frame {frame.view}", previews.to_uint8(previews.tone_map(linear, exposure))),
                ("rendering", previews.preview_rgb(sensor, ours, exposure, colours)),
                ("difference x 5", previews.to_uint8(5.0 * difference)),
            ]
            if sensor.polarizer_angles_deg is not None:
                stokes = intensities_to_stokes(torch.from_numpy(measured), sensor.polarizer_angles_deg).numpy()
                row += [("AoLP (hue), DoLP (value): frame", previews.to_uint8(previews.preview_aolp(stokes)))]
                row += [("rendering", previews.to_uint8(previews.preview_aolp(rendering.stokes[name])))]
            if first:
                geometry = [("depth", previews.preview_depth(rendering.depth_z)), ("normals", previews.preview_normal(rendering.normal))]
                geometry.append(("opacity", previews.to_uint8(rendering.opacity)))
            rows.append(row)
    shown = next((of[0] for of in frames.values() if of), None)
    if field.predicted and shown is not None:
        rows += _predicted_rows(field, shown)
    return view, [*rows, geometry] if rows else rows


def _predicted_rows(field: Field, frame: Frame) -> list[list[tuple[str, np.ndarray]]]:
    """Of each modality that a prior predicts, at a frame's pose: prediction | deviation, for polarization also AoLP and DoLP."""
    rendering = field.render(frame.camera, field.pose_of(frame), field.predicted, geometry=False)
    rows = []
    for name in field.predicted:
        sensor, ours = field.sensors[name], rendering.channels[name]
        exposure = previews.exposure_of(previews.preview_linear(sensor, ours))
        deviation = np.nan_to_num(rendering.deviation[name]).mean(-1)
        row = [
            (f"{name}: predicted", previews.preview_rgb(sensor, ours, exposure)),
            ("its deviation x 5", previews.to_uint8(5.0 * deviation)),
        ]
        if sensor.is_polarization:
            row += [("AoLP (hue), DoLP (value): predicted", previews.to_uint8(previews.preview_aolp(rendering.stokes[name])))]
        rows.append(row)
    return rows


def _score_table(evaluation: Mapping[str, Any]) -> tuple[list[str], list[tuple[str, list[str]]]]:
    modalities: Mapping[str, Mapping[str, Any]] = evaluation.get("modalities", {})
    keys = [key for key in _COLUMNS if any(key in scores for scores in modalities.values())]
    table = [
        (f"{name} (predicted)" if scores.get("predicted") else name, [_shown(scores.get(key), _COLUMNS[key][1]) for key in keys])
        for name, scores in modalities.items()
    ]
    return [_COLUMNS[key][0] for key in keys], table


def _shown(value: Any, decimals: int = 4) -> str:
    if value is None:
        return ""
    return f"{value:.{decimals}f}" if isinstance(value, float) else str(value)


def _score_note(evaluation: Mapping[str, Any], unit: str) -> str:
    parts = [f"Test views: {', '.join(map(str, evaluation.get('views', [])))}."]
    geometry = evaluation.get("geometry", {})
    if geometry:
        labels = {
            "depth_mae": f"depth error {{:.4g}} {unit}",
            "normal_mae_deg": "normal error {:.2f}°",
            "normal_median_deg": "median {:.2f}°",
            "hit_rate": "surface hit {:.1%}",
            "chamfer_visible": f"Chamfer {{:.4g}} {unit}",
        }
        parts.append("Geometry: " + ", ".join(text.format(geometry[key]) for key, text in labels.items() if key in geometry) + ".")
    if "rays_per_s" in evaluation:
        parts.append(f"Rendered at {evaluation['rays_per_s']:,.0f} rays/s.")
    return " ".join(parts)


def _flat(value: Any, prefix: str = "") -> list[tuple[str, str]]:
    """Nested dictionaries → (dotted key, value) lines; long lists are not for a page."""
    if isinstance(value, Mapping):
        return [line for key, inner in value.items() for line in _flat(inner, f"{prefix}.{key}" if prefix else str(key))]
    if isinstance(value, float):
        return [(prefix, f"{value:.6g}")]
    return [(prefix, str(value))] if not isinstance(value, (list, tuple)) or len(value) <= 12 else []


_RUN_FACTS = ("mmsynth", "seed", "steps", "seconds", "rays_per_s", "samples_per_s", "versions", "threads", "cores", "device")


def write_run_report(
    run_dir: Path | str,
    field: Field,
    *,
    evaluation: Mapping[str, Any] | None = None,
    train_log: Path | Sequence[Mapping[str, Any]] | None = None,
    scene: Scene | None = None,
) -> Path:
    """Write ``<run_dir>/report.html`` and, where there are pictures, the same as one contact sheet, ``<run_dir>/preview.png``.

    Args:
        evaluation: what ``evaluate`` returned; None: no table of scores.
        train_log: entries of train.jsonl or its path; None: the run's own.
        scene: for the pictures; None: the scene that the field's manifest names, and no pictures if it is gone.
    """
    run_dir = Path(run_dir)
    manifest = field.manifest
    log = read_log(train_log or run_dir / "train.jsonl") if train_log is None or isinstance(train_log, (str, Path)) else train_log
    scene = _scene_of(manifest) if scene is None else scene
    view, rows = picture_rows(field, scene) if scene is not None else (None, [])
    columns, scores = _score_table(evaluation or {})
    needs = manifest.get("needs", {})
    name = scene.root.resolve().name if scene is not None else run_dir.name
    region = field.region
    centre = ", ".join(f"{c:.4g}" for c in region.centre)
    facts = _flat({key: manifest[key] for key in _RUN_FACTS if key in manifest})
    needed = [(name, choice.why) for name, choice in choices_of(manifest).items()] + _flat(
        {k: v for k, v in needs.items() if k != "choices"}
    )
    page = {
        "title": f"mmsynth: {name}",
        "subtitle": f"{len(field.sensors)} modalities: {', '.join(field.sensors)}. "
        f"Region of interest: centre {centre}, radius {region.radius:.4g} [{field.unit}].",
        "columns": columns,
        "scores": scores,
        "score_note": _score_note(evaluation or {}, field.unit),
        "pictures_title": f"View {view}",
        "rows": [[(caption, _source(image)) for caption, image in row] for row in rows],
        "curve": curve_svg(log),
        "tables": [("What the scene needed", needed), ("The run", facts)],
    }
    if rows:
        images = [[image for _, image in row] for row in rows]
        captions = [[caption for caption, _ in row] for row in rows]
        previews.contact_sheet(images, captions, run_dir / "preview.png")
    path = run_dir / "report.html"
    write_page(path, _BODY, page)
    return path


def _scene_of(manifest: Mapping[str, Any]) -> Scene | None:
    from mmsynth.scene.load import load_again

    stated = manifest.get("scene", {})
    if not stated.get("path"):
        return None
    try:
        return load_again(stated)
    except InputError:
        return None
