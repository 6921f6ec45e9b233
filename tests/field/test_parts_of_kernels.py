"""Parts of kernels are compiled with the kernels that call them, and nowhere else."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from from_python import from_python
from numba import types
from numba.core.errors import TypingError

from mmsynth.field.kernels.cpu.jit import allocating_part, part
from mmsynth.field.kernels.cpu.stack import on_stack


@allocating_part()
def halved(values: np.ndarray) -> Any:
    return values * np.float32(0.5), values.sum()


@allocating_part()
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


def test_a_part_that_does_not_say_so_makes_no_array() -> None:
    with pytest.raises(TypingError, match="NRT required but not enabled"):
        from_python(part(lambda values: np.zeros(3) + values))(1.0)
    with pytest.raises(TypingError, match="passed into the function"):
        from_python(part(lambda values: values * 2.0))(np.ones(3))


_three, _flags = on_stack(types.float64, 3), on_stack(types.boolean, 5)


@part()
def lengths(points: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(points)):
        squares, last, met = _three(), _three(), _flags()
        last[:] = 0.0
        met[:] = False
        for a in range(3):
            squares[a] = points[i, a] * points[i, a]
            last[a] = squares[a] + (last[a - 1] if a else 0.0)
            met[a + 1] = True
        out[i] = np.sqrt(last[2]) if met.sum() == 3 else np.nan


def test_arrays_on_the_stack_lie_apart() -> None:
    points, out = np.random.default_rng(0).random((1000, 3)), np.zeros(1000)
    from_python(lengths)(points, out)
    np.testing.assert_allclose(out, np.linalg.norm(points, axis=1), rtol=1e-14)
