"""What every HTML page of a report has: its head and style, and figures as SVG inside it. One file, no script."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from mmsynth.files import write_text

_HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1080px; margin: 2rem auto; padding: 0 1rem; color: #222; background: #fff }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2rem; border-bottom: 1px solid #ddd }
.scroll { overflow-x: auto } table { border-collapse: collapse }
td, th { padding: .25rem .8rem; border-bottom: 1px solid #eee; text-align: left; vertical-align: top }
td.number { text-align: right; font-variant-numeric: tabular-nums }
figure { display: inline-block; margin: .4rem .6rem .4rem 0 } figcaption { font-size: .85rem; color: #555 }
figure img { height: 200px; image-rendering: pixelated }
svg { max-width: 100%; height: auto } .note { color: #555; font-size: .9rem }
</style></head><body>
<h1>{{ title }}</h1>
"""


def write_page(path: Path, body: str, values: Mapping[str, Any]) -> None:
    """Write a page: ``body`` is the template of what follows its heading, ``values`` what it is filled with, ``title`` among them.

    Raises:
        InputError: cannot be written.
    """
    write_text(path, jinja2.Environment(autoescape=True).from_string(_HEAD + body + "</body></html>\n").render(values))


def svg(figure: Figure) -> str:
    """A figure as an SVG element; the same figure gives the same text."""
    stream = io.StringIO()
    FigureCanvasSVG(figure).print_svg(stream, metadata={"Date": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]
