"""The files of a benchmark: ``results.json``, ``report.md``, ``report.html`` and ``plot.svg``, each written whole or not at all."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mmsynth.bench.machine import describe
from mmsynth.bench.tables import Table, markdown
from mmsynth.files import write_json, write_text
from mmsynth.report.page import links_to, svg, write_page

_FILES = (("results.json", "all numbers"), ("report.md", "the tables as Markdown"), ("plot.svg", "the plot"), ("rows/*.json", "one row"))

_BODY = """\
{% for heading, header, rows, note in tables %}<h2 id="table-{{ loop.index }}">{{ heading }}</h2>
{{ table(heading, header, rows) }}
{% if note %}<p class="note">{{ note }}</p>{% endif %}{% endfor %}
{% if plot %}<h2 id="plot">Plot</h2>{{ drawing(plot, "the numbers of the tables drawn") }}{% endif %}
<h2 id="files">Files</h2>{{ links(files) }}
"""


@dataclass(frozen=True)
class Report:
    """A finished bench.

    Attributes:
        results: ready for JSON: ``bench, machine, rows`` and what the bench adds. tables: the same to read. out: the folder it lies in.
        files: names of what was written there.
    """

    results: dict[str, Any]
    tables: Sequence[Table]
    out: Path
    files: tuple[str, ...] = ()


def write_report(results: dict[str, Any], tables: Sequence[Table], figure: Figure | None, out: Path) -> Report:
    """Write the four files, or three where there is nothing to plot.

    Raises:
        InputError: ``out`` cannot be written.
    """
    title = f"# mmsynth bench {results['bench']}\n\n{describe(results['machine'])}\n"
    plot = [] if figure is None else ["![plot](plot.svg)", ""]
    write_text(out / "report.md", "\n".join([title, *map(markdown, tables), *plot]))
    drawn = None if figure is None else svg(figure)
    if drawn is not None:
        write_text(out / "plot.svg", drawn)
    write_json(out / "results.json", results)
    page = {
        "title": f"mmsynth bench {results['bench']}",
        "subtitle": describe(results["machine"]),
        "tables": [(one.title, [c.heading for c in one.filled()], _cells(one), one.note) for one in tables],
        "plot": drawn,
        "files": links_to(out, _FILES),
    }
    write_page(out / "report.html", _BODY, page)
    return Report(results, tables, out, ("results.json", "report.md", "report.html", *(["plot.svg"] if plot else [])))


def _cells(table: Table) -> list[list[str]]:
    return [[column.cell(row) for column in table.filled()] for row in table.rows]


def new_figure(panels: int, height: float = 4.2) -> tuple[Figure, list[Axes]]:
    """A figure of panels side by side, each with a faint grid; ``height`` in inches."""
    figure = Figure(figsize=(6.4 * panels, height), layout="constrained")
    axes = list(figure.subplots(1, panels, squeeze=False)[0])
    for one in axes:
        one.grid(alpha=0.25)
    return figure, axes


def line_panels(
    panels: Mapping[str, Mapping[str, Mapping[float, float | None]]], x: str, ticks: Mapping[float, str], **axis: Any
) -> Figure:
    """Lines over log x: label of a panel's y axis → name of a line → x → y. A panel without any y is left out, as is a y that is None.

    Args:
        x: label of the axis. ticks: its marks. axis: of every panel, as for ``Axes.set``.
    """
    panels = {label: lines for label, lines in panels.items() if any(y is not None for line in lines.values() for y in line.values())}
    figure, axes = new_figure(len(panels))
    for one, (label, lines) in zip(axes, panels.items(), strict=True):
        for name, line in lines.items():
            known = {x: y for x, y in line.items() if y is not None}
            style: Any = {"color": "black", "linewidth": 2} if name == "mean" else {}
            one.plot(list(known), list(known.values()), "o-", label=name, **style)
        one.set(xscale="log", xlabel=x, ylabel=label, **axis)
        one.set_xticks(list(ticks), list(ticks.values()))
        one.minorticks_off()
        one.legend(frameon=False, fontsize=7)
    return figure


def scatter_panels(rows: Sequence[Mapping[str, Any]], x: tuple[str, str], y: tuple[str, str], label: str, ours: str = "") -> Figure:
    """Error over speed, both log, a panel per family of methods.

    Args:
        x, y: key of a row and label of the axis, which may name other keys in braces; rows without a finite y are left out.
        label: of a point, from the keys of its row; those of one label have one colour. ours: methods with it in their name are filled,
            with "" all.
    """
    rows = [row for row in rows if math.isfinite(row.get(y[0], math.inf))]
    families = list(dict.fromkeys(row["family"] for row in rows))
    figure, axes = new_figure(len(families))
    for one, family in zip(axes, families, strict=True):
        here = [row for row in rows if row["family"] == family]
        for i, name in enumerate(dict.fromkeys(label.format_map(row) for row in here)):
            points = [row for row in here if label.format_map(row) == name]
            face = f"C{i % 10}" if ours in points[0]["method"] else "none"
            values = [max(row[y[0]], 1e-16) for row in points]
            one.scatter([row[x[0]] for row in points], values, s=24, facecolors=face, edgecolors=f"C{i % 10}", label=name)
        one.set(xscale="log", yscale="log", xlabel=x[1], ylabel=y[1].format_map(here[0]), title=family)
        one.legend(frameon=False, fontsize=7)
    return figure
