"""What a bench leaves behind: ``results.json``, ``report.md`` and ``plot.svg``, each written whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from mmsynth.bench.machine import describe
from mmsynth.bench.tables import Table, markdown
from mmsynth.files import write_atomic, write_json, write_text


@dataclass(frozen=True)
class Report:
    """A finished bench.

    Attributes:
        results: ready for JSON: ``bench, machine, rows`` and what the bench adds. tables: the same to read. out: the folder it lies in.
    """

    results: dict[str, Any]
    tables: Sequence[Table]
    out: Path


def write_report(results: dict[str, Any], tables: Sequence[Table], figure: Figure, out: Path) -> Report:
    """Write the three files.

    Raises:
        InputError: ``out`` cannot be written.
    """
    title = f"# mmsynth bench {results['bench']}\n\n{describe(results['machine'])}\n"
    write_text(out / "report.md", "\n".join([title, *map(markdown, tables), "![plot](plot.svg)", ""]))
    write_atomic(out / "plot.svg", lambda path: FigureCanvasSVG(figure).print_svg(path, metadata={"Date": None}))
    write_json(out / "results.json", results)
    return Report(results, tables, out)


def new_figure(panels: int, height: float = 4.2) -> tuple[Figure, list[Axes]]:
    """A figure of panels side by side, each with a faint grid; ``height`` in inches."""
    figure = Figure(figsize=(6.4 * panels, height), layout="constrained")
    axes = list(figure.subplots(1, panels, squeeze=False)[0])
    for one in axes:
        one.grid(alpha=0.25)
    return figure, axes
