"""What ruff and mypy say: among the tests, where a whole core's time of types is checked while others run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.parametrize("check", ["ruff check .", "ruff format --check .", "mypy mmsynth"])
def test_checks_have_nothing_to_say(check: str) -> None:
    said = subprocess.run([sys.executable, "-m", *check.split()], cwd=ROOT, capture_output=True, text=True)
    assert said.returncode == 0, said.stdout[-5000:] + said.stderr[-2000:]
