"""``report.html`` of a dataset: what is in it, pictures of some of its views, and all its files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from mmsynth.operations.dataset.aligned import AlignedDataset
from mmsynth.operations.output import previews
from mmsynth.report.page import links_to, size_text, write_page
from mmsynth.report.pictures import Picture, Row, depth_map, encode_rows, share_map
from mmsynth.scene.scene import Sensor

_SHOWN = 24  # views with pictures
_LISTED = 1000  # views in the table
_FILES = (
    ("dataset.json", "conventions, sensors, cameras, poses, checksums"),
    ("transforms*.json", "the views as nerfstudio reads them"),
    ("meta_data.json", "the views as a scene that can be fitted"),
    ("raw/meta_data.json", "simulated raw frames, a scene that can be fitted"),
    ("shards/*.tar", "views"),
)

_BODY = """\
<h2 id="modalities">Modalities</h2>
{{ table("modalities", ["modality", "channels", "wavelengths [nm]", "analysers [°]", ""], modalities) }}
<h2 id="pictures">{{ shown }}</h2>
<p class="note">Tone-mapped, each modality with one exposure for all views. Colours of depth have a scale of their own in each view.</p>
<p class="note hint">A click or Enter enlarges a picture.</p>
{% for row in rows %}{{ modality(row) }}{% endfor %}
<h2 id="views">All views</h2>
{{ table("all views", ["view", "pose", "size", "coverage score", "bytes", "files"], views) }}
{% if coverage %}<p class="note">Coverage: how well the training frames saw what the view shows, 1 = as their own pixels.</p>{% endif %}
{% if more %}<p class="note">{{ more }} more are in dataset.json.</p>{% endif %}
<h2 id="files">Files</h2>{{ links(files) }}
"""


def write_dataset_report(out: Path) -> Path:
    """Write the page of a finished dataset into its folder. It is no part of the dataset: no checksum is of it.

    Raises:
        InputError: no dataset there, a file of it is damaged, or the page cannot be written.
    """
    dataset = AlignedDataset(out)
    content = dataset.content
    views = content["views"]
    indices = sorted({round(i) for i in np.linspace(0, len(views) - 1, min(len(views), _SHOWN))})
    scores = [view["coverage_score"] for view in views if "coverage_score" in view]
    parts = [f"{content.get('rig', 'aligned')} rig", f"format {content.get('format', 'npz')}"]
    if scores:
        parts.append(f"coverage score {min(scores):.2f} to {max(scores):.2f}")
    page = {
        "title": f"Dataset of {len(views)} views",
        "subtitle": ", ".join(parts) + ".",
        "modalities": [_modality(name, stated) for name, stated in content["modalities"].items()],
        "shown": "Views" if len(indices) == len(views) else f"{len(indices)} of {len(views)} views",
        "rows": encode_rows(_rows(dataset, indices)),
        "views": [_line(index, view) for index, view in enumerate(views[:_LISTED])],
        "coverage": bool(scores),
        "more": max(0, len(views) - _LISTED),
        "files": links_to(out, _FILES),
    }
    write_page(out / "report.html", _BODY, page)
    return out / "report.html"


def _modality(name: str, stated: Mapping[str, Any]) -> list[str]:
    waves = [f"{nm:g}" for nm in stated["wavelengths_nm"] if nm is not None]
    angles = [f"{angle:g}" for angle in stated["polarizer_angles_deg"] or ()]
    predicted = "predicted, not measured" if stated.get("predicted") else ""
    return [name, ", ".join(stated["channels"]), ", ".join(waves), ", ".join(angles), predicted]


def _line(index: int, view: Mapping[str, Any]) -> list[Any]:
    """A view's row in the table of all."""
    camera = next(iter(view["cameras"].values()))
    if "shard" in view:
        files = Markup('<a href="{}">{}</a>').format(quote(view["shard"]), view["shard"])
    else:
        names = [f"{view['folder']}/{name}" for name in [*view["files"], "view.json"]]
        files = Markup(" ").join(Markup('<a href="{}">{}</a>').format(quote(name), name.rsplit("/", 1)[-1]) for name in names)
    score = f"{view['coverage_score']:.3f}" if "coverage_score" in view else ""
    size = sum(stated["bytes"] for stated in view["files"].values())
    return [f"{index:04d}", view["name"], f"{camera['width']}x{camera['height']}", score, size_text(size), files]


def _rows(dataset: AlignedDataset, indices: list[int]) -> list[Row]:
    exposures: dict[str, float] = {}
    rows = []
    for index in indices:
        item = dataset[index]
        pictures = []
        for name in dataset.modalities:
            stated = dataset.content["modalities"][name]
            angles = stated["polarizer_angles_deg"]
            sensor = Sensor(
                name, tuple(stated["channels"]), tuple(stated["wavelengths_nm"]), None, None if angles is None else tuple(angles)
            )
            values = item[name].movedim(0, -1).numpy()
            exposure = exposures.setdefault(name, previews.exposure_of(previews.preview_linear(sensor, values)))
            pictures.append(Picture(name, previews.preview_rgb(sensor, values, exposure), f"{name} of view {index:04d}"))
        for key in (key for key in item if key.rsplit("/", 1)[-1] in ("depth_z", "coverage")):
            numbers, what = item[key].squeeze(0).numpy(), key.replace("depth_z", "depth").replace("/", " ")
            image, scale = (
                share_map(numbers, 0.0, 1.0, "") if key.endswith("coverage") else depth_map(numbers, str(dataset.content.get("unit", "")))
            )
            pictures.append(Picture(what, image, f"{what} of view {index:04d}", scale))
        score = dataset.content["views"][index].get("coverage_score")
        rows.append(Row(f"view {index:04d}", pictures, "" if score is None else f"Coverage score {score:.3f}.", compact=True))
    return rows
