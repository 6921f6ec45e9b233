"""Parts of kernels are compiled with the kernels that call them, and nowhere else."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from from_python import from_python

from mmsynth.field.kernels.cpu.jit import part


@part()
def halved(values: np.ndarray) -> Any:
    return values * np.float32(0.5), values.sum()


@part()
def quartered(values: np.ndarray) -> Any:
    """A part that calls a part, makes an array and can raise."""
    if values.size == 0:
        raise ValueError("no values")
    return halved(halved(values)[0])


called = from_python(quartered)


@pytest.fixture(autouse=True)
def _timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "LLVM_PASS_TIMINGS", True)


def _stages(function: Any) -> str:
    (overload,) = function.overloads.values()
    return " ".join(record.name for record in overload.metadata["llvm_pass_timings"])


def test_a_part_gives_what_python_would_and_has_no_machine_code_of_its_own() -> None:
    values = np.random.default_rng(0).random(37, dtype=np.float32)
    got, total = called(values)
    np.testing.assert_array_equal(got, values * np.float32(0.25))
    assert total == pytest.approx(0.5 * values.sum(), rel=1e-6)
    assert "Finalize object" in _stages(called) and "full optimization" in _stages(called)
    for inner in (quartered, halved):
        assert "Finalize object" not in _stages(inner) and "full optimization" not in _stages(inner)


def test_what_a_part_raises_comes_through() -> None:
    with pytest.raises(ValueError, match="no values"):
        called(np.zeros(0, np.float32))
