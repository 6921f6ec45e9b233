"""The GPU kernels to machine code of GPUs that are not there: the interpreter accepts more than the compiler does."""

import importlib.util
import re
import sys
from pathlib import Path

import pytest

from mmsynth.bench import gpu
from mmsynth.bench.launches import device_step, example_trainer, step_launches
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


def _rows_beyond(ttgir: str) -> list[str]:
    """Products of whole groups of warps (Hopper's) whose warps have more rows than there are."""
    rows = {}
    for name, warps, height in re.findall(
        r"#(mma\d*) = #ttg.nvidia_mma<{versionMajor = 3,.*?warpsPerCTA = \[(\d+), \d+\], instrShape = \[(\d+),", ttgir
    ):
        rows[name] = int(warps) * int(height)
    products = re.findall(r"warp_group_dot .*-> tensor<(\d+)x\d+xf32, #(mma\d*)>", ttgir)
    assert bool(products) == ("warp_group_dot " in ttgir)
    return [f"{name}: {rows[name]} rows of {height}" for height, name in products if rows[name] > int(height)]


# bytes, of what a thread keeps: loads and stores of its own cache line
SPILLED = {"surface_backward": {80: 256, 90: 0, 100: 64}, "march": {80: 32, 90: 8}}


@pytest.mark.slow
@pytest.mark.parametrize("target", gpu.TARGETS)
def test_every_kernel_compiles_and_where_it_spills_is_known(target: int, launches: list[gpu.Launch]) -> None:
    for launch in launches:
        found, result = gpu.compiled(launch, target)
        assert result.asm["cubin"] and 0 < found.registers <= 255
        assert found.spilled <= SPILLED.get(launch.name, {}).get(target, 0), launch.name
        assert not _rows_beyond(result.asm["ttgir"]), launch.name
        if launch.name in ("encode", "march"):  # the features of a row in one access
            assert "ld.global.v4.b32" in result.asm["ptx"], launch.name


# of what triton 3.6 makes of a chain of two products of 64 rows for eight warps: the upper four read beyond the shared memory
EIGHT_WARPS = """
#mma = #ttg.nvidia_mma<{versionMajor = 3, versionMinor = 0, warpsPerCTA = [4, 2], instrShape = [16, 16, 8]}>
#mma1 = #ttg.nvidia_mma<{versionMajor = 3, versionMinor = 0, warpsPerCTA = [8, 1], instrShape = [16, 32, 8]}>
%1 = ttng.warp_group_dot %a, %b, %c {inputPrecision = 0 : i32} : tensor<64x32xf32> * !ttg.memdesc<32x64xf32> -> tensor<64x64xf32, #mma>
%2 = ttng.warp_group_dot %1, %b, %c {inputPrecision = 0 : i32} : tensor<64x64xf32> * !ttg.memdesc<64x64xf32> -> tensor<64x64xf32, #mma1>
"""


@pytest.mark.slow
def test_no_warp_multiplies_rows_that_are_not_there() -> None:
    """An H100 found it: an illegal memory access in the second step of a fit."""
    assert _rows_beyond(EIGHT_WARPS) == ["mma1: 128 rows of 64"]
    found = {launch.name: launch for launch in step_launches(device_step(example_trainer(), 3), True).calls}
    for name in ("compare", "light", "light_backward"):
        assert not _rows_beyond(gpu.compiled(found[name], 90)[1].asm["ttgir"]), name


def test_without_triton_one_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(InputError, match="triton is not installed"):
        gpu.bench_gpu(tmp_path)
