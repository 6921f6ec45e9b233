"""The GPU kernels to machine code of GPUs that are not there: the interpreter accepts more than the compiler does."""

import importlib.util
import sys
from pathlib import Path

import pytest
from hopper import EIGHT_WARPS, rows_beyond

from mmsynth.bench import gpu
from mmsynth.errors import InputError

pytestmark = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")


@pytest.fixture(scope="module")
def launches() -> list[gpu.Launch]:
    """A launch of each kernel, as a fit makes them."""
    first: dict[str, gpu.Launch] = {}
    for call in gpu.calls()[:4]:
        for launch in gpu.launches_of(call):
            first.setdefault(launch.name, launch)
    return list(first.values())


def test_calls_are_recorded_and_do_not_run() -> None:
    names = [launch.name for launch in gpu.launches_of(gpu.calls()[0])]
    assert names == ["enter", "march", "weigh", "look", "look_backward", "weigh_backward", "surface_backward"]
    names = [launch.name for launch in gpu.launches_of(gpu.calls()[-1])]
    assert names[-1] == "rays_backward"


# bytes, of what a thread keeps: loads and stores of its own cache line
SPILLED = {"surface_backward": {80: 256, 90: 0, 100: 64}, "march": {80: 32, 90: 8}}


@pytest.mark.slow
@pytest.mark.parametrize("target", gpu.TARGETS)
def test_every_kernel_compiles_and_where_it_spills_is_known(target: int, launches: list[gpu.Launch]) -> None:
    for launch in launches:
        found, result = gpu.compiled(launch, target)
        assert result.asm["cubin"] and 0 < found.registers <= 255
        assert found.spilled <= SPILLED.get(launch.name, {}).get(target, 0), launch.name
        assert not rows_beyond(result.asm["ttgir"]), launch.name
        if launch.name in ("encode", "march"):  # the features of a row in one access
            assert "ld.global.v4.b32" in result.asm["ptx"], launch.name


def test_rows_that_are_not_there_are_found() -> None:
    assert rows_beyond(EIGHT_WARPS) == ["mma1: 128 rows of 64"]


def test_without_triton_one_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(InputError, match="triton is not installed"):
        gpu.bench_gpu(tmp_path)
