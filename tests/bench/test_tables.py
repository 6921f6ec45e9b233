"""Tables for the terminal and for Markdown."""

from __future__ import annotations

import pytest

from mmsynth.bench.tables import MISSING, Column, Table, lookup, markdown, print_tables

ROWS = [
    {"name": "a|b", "mean": {"psnr": 31.257}, "steps": 1234, "difference": {"mean": 0.5, "spread": None}},
    {"name": "[red]c", "mean": {}, "steps": 5, "difference": {"mean": -0.25, "spread": 0.125}},
]
TABLE = Table(
    "Title",
    (
        Column("name", "name"),
        Column("PSNR", "mean/psnr", ".2f"),
        Column("steps", "steps", ",d"),
        Column("Δ", "difference", "+.2f"),
        Column("k", "steps", ".3f", 1e-3),
        Column("none has it", "mean/sam", ".2f"),
    ),
    ROWS,
    "Note.",
)


def test_cells() -> None:
    assert [[c.cell(row) for c in TABLE.filled()] for row in ROWS] == [
        ["a|b", "31.26", "1,234", "+0.50", "1.234"],
        ["[red]c", MISSING, "5", "-0.25 ± 0.12", "0.005"],
    ]


def test_lookup() -> None:
    assert lookup(ROWS[0], "mean/psnr") == 31.257 and lookup(ROWS[0], "name/psnr") is None and lookup({}, "a/b") is None


def test_markdown() -> None:
    lines = markdown(TABLE).splitlines()
    assert lines[0] == "## Title" and lines[-1] == "Note."
    assert lines[2:5] == ["| name | PSNR | steps | Δ | k |", "|:--|--:|--:|--:|--:|", r"| a\|b | 31.26 | 1,234 | +0.50 | 1.234 |"]


def test_numbers_are_never_cut_on_the_terminal(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    print_tables([TABLE])
    said = capsys.readouterr().out
    for text in ("Title", "31.26", "-0.25 ± 0.12", "[red]c", "Note."):
        assert text in said
