"""That sums and products of integers which overflow end a test in Triton's interpreter: places in an array, above all."""

from __future__ import annotations

import pytest
import torch

triton = pytest.importorskip("triton")
tl = pytest.importorskip("triton.language")


@triton.jit
def _times_65536(numbers, out, count: tl.constexpr):  # type: ignore[no-untyped-def]
    i = tl.arange(0, count)
    tl.store(out + i, tl.load(numbers + i) * 65536)


def test_a_product_that_overflows_is_noticed(device: str) -> None:
    if device != "cpu":
        pytest.skip("a GPU does not look")
    out = torch.zeros(8, dtype=torch.int32)
    _times_65536[(1,)](torch.full((8,), 3, dtype=torch.int32), out, 8)
    assert out.tolist() == [3 * 65536] * 8
    with pytest.raises(Exception, match="int32 overflow detected for operation mul"):
        _times_65536[(1,)](torch.full((8,), 70_000, dtype=torch.int32), out, 8)
