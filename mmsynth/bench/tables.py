"""What a bench found, as tables: one description for the terminal and for Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

MISSING = "–"


@dataclass(frozen=True)
class Column:
    """``path``: where in a row the value is, keys joined by ``/``. ``form``: format of a number, as in an f-string; "" is for text.

    A value ``{"mean", "spread"}`` is shown as "mean ± spread", one that is missing as –; ``scale`` multiplies numbers.
    """

    heading: str
    path: str
    form: str = ""
    scale: float = 1.0

    def cell(self, row: Mapping[str, Any]) -> str:
        value = lookup(row, self.path)
        if isinstance(value, Mapping):
            spread = "" if value["spread"] is None else f" ± {value['spread'] * self.scale:{self.form.lstrip('+')}}"
            return f"{value['mean'] * self.scale:{self.form}}{spread}"
        if isinstance(value, (int, float)):
            return f"{value * self.scale if self.scale != 1.0 else value:{self.form}}"
        return MISSING if value is None else str(value)


def numbers(form: str, paths: Mapping[str, str], scale: float = 1.0) -> tuple[Column, ...]:
    """Columns of one format; ``paths``: by heading."""
    return tuple(Column(heading, path, form, scale) for heading, path in paths.items())


@dataclass(frozen=True)
class Table:
    """Rows of nested dictionaries under a title; ``note``: a sentence below it."""

    title: str
    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Any]]
    note: str = ""

    def filled(self) -> list[Column]:
        """The columns that some row has a value for."""
        return [c for c in self.columns if any(lookup(row, c.path) is not None for row in self.rows)]


def lookup(row: Mapping[str, Any], path: str) -> Any:
    """The value at keys joined by ``/``; None where a key is missing."""
    value: Any = row
    for key in path.split("/"):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def markdown(table: Table) -> str:
    """The table with its title and note; numbers to the right."""
    columns = table.filled()
    texts = [[c.heading for c in columns], *([c.cell(row) for c in columns] for row in table.rows)]
    lines = ["| " + " | ".join(text.replace("|", r"\|") for text in line) + " |" for line in texts]
    lines.insert(1, "|" + "|".join("--:" if c.form else ":--" for c in columns) + "|")
    note = ["", table.note] if table.note else []
    return "\n".join([f"## {table.title}", "", *lines, *note, ""])


def print_tables(tables: Sequence[Table]) -> None:
    """Print on the terminal, at their own width: a number cut off or broken over two lines is no number."""
    console = Console(width=1000, highlight=False)
    for table in tables:
        shown = RichTable(title=escape(table.title), caption=escape(table.note) or None, box=box.SIMPLE, title_justify="left")
        shown.caption_justify = "left"
        for column in table.filled():
            shown.add_column(escape(column.heading), justify="right" if column.form else "left")
        for row in table.rows:
            shown.add_row(*(escape(column.cell(row)) for column in table.filled()))
        console.print(shown)
