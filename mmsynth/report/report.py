"""One self-contained HTML page per run: scores, test views, curve, decisions, files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from mmsynth.errors import InputError
from mmsynth.fitting.choices import choices_of
from mmsynth.operations.output import previews
from mmsynth.report.page import links_to, svg, write_page
from mmsynth.report.pictures import Picture, Row, encode_rows
from mmsynth.report.run_pictures import measured_channels as measured_channels
from mmsynth.report.run_pictures import picture_rows
from mmsynth.report.text import moved_text
from mmsynth.scene.scene import Scene

if TYPE_CHECKING:
    from mmsynth.field.field import Field

# what each score means to a reader: label, decimals
_COLUMNS = {
    "psnr": ("PSNR [dB]", 2),
    "psnr_view_mean": ("PSNR, mean of dB over views", 2),
    "psnr_foreground": ("PSNR foreground, pooled [dB]", 2),
    "psnr_foreground_view_mean": ("PSNR foreground, mean of dB over views", 2),
    "psnr_moved": ("PSNR, test cameras moved [dB]", 2),
    "psnr_foreground_moved": ("PSNR foreground, test cameras moved [dB]", 2),
    "foreground_from": ("foreground from", 0),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 3),
    "psnr_truth": ("PSNR against truth [dB]", 2),
    "psnr_truth_moved": ("PSNR against truth, test cameras moved [dB]", 2),
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

_PARTS = ("psnr_highlights", "psnr_silhouettes", "psnr_rest")

# files of a run folder and of what was made of it, as far as they are there
_FILES = (
    ("field.safetensors", "the field"),
    ("manifest.json", "scene, recipe, decisions, versions, times"),
    ("train.jsonl", "the curve"),
    ("preview.png", "the pictures of this page on one sheet"),
    ("checkpoint/state.pt", "to go on from"),
    ("*.ply", "mesh"),
    ("*.glb", "mesh"),
    ("*.obj", "mesh"),
    ("*.stl", "mesh"),
    ("dataset/report.html", "the dataset's page"),
    ("dataset/dataset.json", "dataset"),
    ("convert/*/report.html", "a conversion's page"),
    ("videos/*.mp4", "video"),
    ("sensors/*.toml", "sensor with its noise"),
    ("simulated/meta_data.json", "simulated raw frames"),
    ("export/*/transforms*.json", "exported scene"),
)

_BODY = """\
{% if scores %}<h2 id="scores">Scores on the test views</h2>
{{ table("scores on the test views", ["modality"] + columns, scores) }}
<p class="note">{{ score_note }}</p>
{% if parts %}<h3>Where the error lies</h3>
{{ table("PSNR of highlights, silhouettes and the rest", ["modality"] + part_columns, parts) }}
<p class="note">Highlights are brighter than what is around them, silhouettes edges of objects and steps of depth.</p>
{% endif %}{% endif %}
{% if rows %}<h2 id="pictures">{{ pictures_title }}</h2>
<p class="note">Pictures are tone-mapped, the frame and its rendering with one exposure; frames are demosaicked for display only. Errors are
|frame - rendering|, the mean over channels; all modalities have one scale.</p>
<p class="note hint">Point at a picture for the light of a pixel, or go there by Tab and use the arrow keys; click or Enter enlarges it.</p>
{% for row in rows %}{{ modality(row) }}{% endfor %}{% endif %}
{% if curve %}<h2 id="fit">The fit</h2>
{{ drawing(curve, "loss and PSNR of the training rays over seconds") }}{% endif %}
{% if decided %}<h2 id="decided">What was decided and why</h2>
{{ table("what was decided and why", ["choice", "value", "why"], decided) }}
<p class="note">In bold: what changed the field or the fit.</p>{% endif %}
<div class="columns">{% for id, heading, lines in tables if lines %}<section><h2 id="{{ id }}">{{ heading }}</h2>
{{ table(heading, ["what", "value"], lines) }}</section>{% endfor %}</div>
{% if files %}<h2 id="files">Files</h2>{{ links(files) }}{% endif %}
"""


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
    from matplotlib.figure import Figure  # a second to import: a fit begins without

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


def _score_tables(evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """Scores of the modalities, and those of the parts of pictures, where these are known, as a table of their own."""
    modalities: Mapping[str, Mapping[str, Any]] = evaluation.get("modalities", {})

    def rows(keys: Sequence[str], of: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
        label = {name: f"{name} (predicted)" if scores.get("predicted") else name for name, scores in of.items()}
        return [[label[name], *(_shown(scores.get(key), _COLUMNS[key][1]) for key in keys)] for name, scores in of.items()]

    told = [key for key in _COLUMNS if any(key in scores for scores in modalities.values())]
    whole, parts = [key for key in told if key not in _PARTS], [key for key in told if key in _PARTS]
    return {
        "columns": [_COLUMNS[key][0] for key in whole],
        "scores": rows(whole, modalities),
        "part_columns": [_COLUMNS[key][0] for key in parts],
        "parts": rows(parts, {n: s for n, s in modalities.items() if any(key in s for key in parts)}),
    }


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
    if moved := evaluation.get("moved_px"):
        parts.append(f"Moved: {moved_text(moved)}.")
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


def _decided(manifest: Mapping[str, Any]) -> list[list[str]]:
    """Choice, value, why; what changed something in bold."""
    rows = []
    for name, choice in choices_of(manifest).items():
        # the reason of a switch begins with its value
        why = choice.why.split(": ", 1)[-1] if choice.why.startswith(("on: ", "off: ")) else choice.why
        shown = Markup("<strong>{}</strong>") if choice.changed else Markup("{}")
        rows.append([shown.format(name.replace("_", " ")), shown.format(_plain(choice.value)), why])
    return rows


def _plain(value: Any) -> str:
    """A value of a choice as a reader would write it."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain(inner)}" for key, inner in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_plain(inner) for inner in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


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
    needs = manifest.get("needs", {})
    name = scene.root.resolve().name if scene is not None else run_dir.name
    region = field.region
    centre = ", ".join(f"{c:.4g}" for c in region.centre)
    if rows:
        images = [[picture.image for picture in _on_sheet(row)] for row in rows]
        captions = [[f"{row.title}: {p.caption}" if i == 0 else p.caption for i, p in enumerate(_on_sheet(row))] for row in rows]
        previews.contact_sheet(images, captions, run_dir / "preview.png")
    page = {
        "title": f"mmsynth: {name}",
        "subtitle": f"{len(field.sensors)} modalities: {', '.join(field.sensors)}. "
        f"Region of interest: centre {centre}, radius {region.radius:.4g} [{field.unit}].",
        **_score_tables(evaluation or {}),
        "score_note": _score_note(evaluation or {}, field.unit),
        "pictures_title": f"View {view}",
        "rows": encode_rows(rows),
        "curve": curve_svg(log),
        "decided": _decided(manifest),
        "tables": [
            ("needed", "What the scene needed", _flat({k: v for k, v in needs.items() if k != "choices"})),
            ("run", "The run", _flat({key: manifest[key] for key in _RUN_FACTS if key in manifest})),
        ],
        "files": links_to(run_dir, _FILES),
    }
    path = run_dir / "report.html"
    write_page(path, _BODY, page)
    return path


def _on_sheet(row: Row) -> list[Picture]:
    """Every picture of a row once."""
    return list({id(picture): picture for picture in row.each()}.values())


def _scene_of(manifest: Mapping[str, Any]) -> Scene | None:
    from mmsynth.scene.load import load_again

    stated = manifest.get("scene", {})
    if not stated.get("path"):
        return None
    try:
        return load_again(stated)
    except InputError:
        return None
