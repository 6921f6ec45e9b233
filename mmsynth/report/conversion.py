"""``report.html`` of a conversion: frames beside what another sensor would have seen there, by which methods and why, and the files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from mmsynth.files import read_json
from mmsynth.operations.output import previews
from mmsynth.report.page import write_page
from mmsynth.report.pictures import Picture, Row, Wipe, angle_scale, encode_rows, share_map
from mmsynth.report.run_pictures import measured_channels
from mmsynth.report.text import converted_text
from mmsynth.scene.images import image_size, read_image
from mmsynth.scene.preview_colours import PreviewColours, preview_colours_of
from mmsynth.scene.scene import Frame, MaskMeaning, Scene, Sensor
from mmsynth.sensors.camera import Camera

_SHOWN = 12  # frames with pictures
_LISTED = 1000

_BODY = """\
<h2 id="pictures">{{ shown }}</h2>
<p class="note">Tone-mapped: a frame with its own exposure, what was made of it with one exposure for all.</p>
<p class="note hint">A click or Enter enlarges a picture.</p>
{% for row in rows %}{{ modality(row) }}{% endfor %}
<h2 id="methods">Methods and why</h2>
<p>{{ why }}</p>
{{ table("weights of the methods for every frame", header, weights) }}
<p class="note">The share of each method, the share of pixels that the frame guided, and the frame's exposure against the field's.</p>
{% if more %}<p class="note">{{ more }} more are in the folder.</p>{% endif %}
"""


def write_conversion_report(out: Path, sidecars: Sequence[Path], source: Sensor, frame_of: Callable[[str], np.ndarray | None]) -> Path:
    """Write the page into the folder of a conversion.

    Args:
        sidecars: of the frames that were converted, below ``out`` (see ``convert_files``).
        frame_of: name of a frame's file → its preview, a display image (H, W, 3); None: it cannot be shown.
    Raises:
        InputError: a file is missing or damaged, or the page cannot be written.
    """
    facts = [read_json(path) for path in sidecars]
    indices = sorted({round(i) for i in np.linspace(0, len(facts) - 1, min(len(facts), _SHOWN))})
    names = list({name: None for one in facts for name in one["weights"]})
    first = facts[0]
    predicted = f" {first['modality']} is predicted by a prior, not measured." if first["predicted"] else ""
    page = {
        "title": f"{first['from']} to {first['modality']}: {len(facts)} frame{'s' * (len(facts) != 1)}",
        "subtitle": f"What {first['modality']} would have seen where {source.name} was.{predicted}",
        "shown": "Frames" if len(indices) == len(facts) else f"{len(indices)} of {len(facts)} frames",
        "rows": encode_rows([_row(sidecars[i].parent, facts[i], frame_of) for i in indices]),
        "why": converted_text(facts),
        "header": ["frame", *names, "guided pixels", "exposure", "files"],
        "weights": [_line(out, path, one, names) for path, one in list(zip(sidecars, facts, strict=True))[:_LISTED]],
        "more": max(0, len(facts) - _LISTED),
    }
    write_page(out / "report.html", _BODY, page)
    return out / "report.html"


def source_previews(scene: Scene, sensor: Sensor, images: Sequence[Path] = ()) -> Callable[[str], np.ndarray | None]:
    """Name of a frame's file → its preview: of ``images`` of the sensor, or else of the scene's frames."""
    own = scene.frames_of(sensor.name)
    colours = preview_colours_of(scene.sensors[sensor.name], own) if own else None

    def preview(name: str) -> np.ndarray | None:
        for path in images:
            if path.name == name:
                # of a camera only the size is asked for
                frame = Frame(sensor.name, 0, path, Camera(*image_size(path), 1.0, 1.0, 0.0, 0.0), np.eye(4))
                return _preview(sensor, frame, scene.masks, colours)
        frames = (frame for frame in own if frame.path.name == name and not images)
        return next((_preview(scene.sensors[sensor.name], frame, scene.masks, colours) for frame in frames), None)

    return preview


def _preview(sensor: Sensor, frame: Frame, masks: MaskMeaning, colours: PreviewColours | None) -> np.ndarray:
    linear = previews.preview_linear(sensor, measured_channels(sensor, frame, masks), colours)
    return previews.to_uint8(previews.reduced(previews.tone_map(linear)))


def _row(folder: Path, facts: Mapping[str, Any], frame_of: Callable[[str], np.ndarray | None]) -> Row:
    """The frame and what was made of it, as a wipe where they have the same pixels; polarization; confidence."""
    name, target = facts["name"], facts["modality"]
    stem = f"{name}_predicted" if facts["predicted"] else name
    made = Picture(target, read_image(folder / f"{stem}.png"), f"{target} converted from {facts['from']}, frame {name}")
    frame = None if facts["frame"] is None else frame_of(facts["frame"])
    pictures: list[Picture | Wipe] = [made]
    if frame is not None:
        theirs = Picture(f"{facts['from']}: {facts['frame']}", frame, f"{facts['from']}: frame {name}")
        pictures = [Wipe(theirs, made)] if frame.shape[:2] == made.image.shape[:2] else [theirs, made]
    if (folder / f"{stem}_aolp.png").is_file():
        angle = read_image(folder / f"{stem}_aolp.png")
        pictures.append(
            Picture("AoLP (hue), DoLP (value)", angle, f"angle of linear polarization of {target}, frame {name}", angle_scale())
        )
    for ending, what in (("dolp", "DoLP"), ("confidence", "confidence")):
        if (folder / f"{stem}_{ending}.png").is_file():
            numbers = read_image(folder / f"{stem}_{ending}.png")
            image, scale = share_map(numbers if numbers.ndim == 2 else numbers[..., 0], 0.0, 1.0, "")
            pictures.append(Picture(what, image, f"{what} of {target}, frame {name}", scale))
    return Row(f"frame {name}", pictures, predicted=bool(facts["predicted"]))


def _line(out: Path, sidecar: Path, facts: Mapping[str, Any], names: Sequence[str]) -> list[Any]:
    folder = sidecar.parent.relative_to(out).as_posix()
    files = [*facts["files"], sidecar.name]
    links = Markup(" ").join(Markup('<a href="{}">{}</a>').format(quote(f"{folder}/{file}"), file) for file in files)
    exposure = "" if facts["frame_exposure"] is None else f"{facts['frame_exposure']:.3f}"
    return [facts["name"], *(f"{facts['weights'].get(name, 0.0):.3f}" for name in names), f"{facts['guided']:.3f}", exposure, links]
