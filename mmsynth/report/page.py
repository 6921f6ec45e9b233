"""What every HTML page of a report has: head, style, script, and figures as SVG inside it. One file that asks nothing of a network.

``page.html`` is the frame of every page, ``parts.html`` what pages are made of (tables, pictures, wipes, drawings), ``page.css`` their
style, on screens, light or dark, and on paper, and ``page.js`` the little that moves: wipes, zoom and the spectrum of a pixel. Without
the script all pictures and numbers are still there.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import jinja2
from markupsafe import Markup

from mmsynth.files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HERE = Path(__file__).parent
_NUMBER = re.compile(r"[-+<]? ?\d[\d.,]*(e[-+]?\d+)?( ?[%°])?( ± .*)?")
_BODY = "{% from 'parts.html' import drawing, links, modality, picture, table, wipe with context %}"


def write_page(path: Path, body: str, values: Mapping[str, Any]) -> None:
    """Write a page.

    Args:
        body: the template of what follows its heading; it may use what ``parts.html`` has. Headings of the second level that have an
            id are listed at the top.
        values: what it is filled with, ``title`` among them; ``subtitle``, if there is one, follows the heading.
    Raises:
        InputError: cannot be written.
    """
    environment = jinja2.Environment(autoescape=True, loader=jinja2.FileSystemLoader(_HERE), trim_blocks=True, lstrip_blocks=True)
    environment.filters["number_columns"] = _number_columns
    main = environment.from_string(_BODY + body).render(values)
    headings = re.findall(r'<h2 id="([^"]*)">(.*?)</h2>', main)
    inside = {"style": Markup((_HERE / "page.css").read_text("utf-8")), "script": Markup((_HERE / "page.js").read_text("utf-8"))}
    contents = [(anchor, Markup(text)) for anchor, text in headings]
    page = environment.get_template("page.html").render({**values, **inside, "main": Markup(main), "contents": contents})
    write_text(path, page + "\n")


def svg(figure: Figure) -> str:
    """A figure as an SVG element; the same figure gives the same text."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG  # a second to import, and most pages have no figure

    stream = io.StringIO()
    FigureCanvasSVG(figure).print_svg(stream, metadata={"Date": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]


@dataclass(frozen=True)
class Link:
    """A file beside the page: its name from there, as an address, too, what it is, size as text."""

    name: str
    address: str
    about: str
    size: str


def links_to(folder: Path, files: Iterable[tuple[str, str]]) -> list[Link]:
    """Those files that are in the page's folder; ``files``: pattern of names below it and what they are, in the order of the page."""
    found: dict[str, Link] = {}
    for pattern, about in files:
        for path in sorted(folder.glob(pattern)):
            name = path.relative_to(folder).as_posix()
            if path.is_file() and not path.name.startswith("."):
                found.setdefault(name, Link(name, quote(name), about, size_text(path.stat().st_size)))
    return list(found.values())


def size_text(size: int) -> str:
    """Bytes → "12 kB"."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= scale:
            return f"{size / scale:.3g} {unit}"
    return f"{size} B"


def _number_columns(rows: Sequence[Sequence[Any]]) -> list[bool]:
    """Which columns of a table hold numbers alone; they are set to the right."""
    cells = [[str(cell) for cell in column if str(cell) not in ("", "–")] for column in zip(*rows, strict=False)]
    return [bool(column) and all(_NUMBER.fullmatch(cell) for cell in column) for column in cells]
