"""What triton 3.6 makes for a GPU of compute capability 9.0, where the compiler is wrong."""

import re

# of what triton 3.6 makes of a chain of two products of 64 rows for eight warps: an H100 found that the upper four read beyond
# the shared memory, an illegal memory access in the second step of a fit
EIGHT_WARPS = """
#mma = #ttg.nvidia_mma<{versionMajor = 3, versionMinor = 0, warpsPerCTA = [4, 2], instrShape = [16, 16, 8]}>
#mma1 = #ttg.nvidia_mma<{versionMajor = 3, versionMinor = 0, warpsPerCTA = [8, 1], instrShape = [16, 32, 8]}>
%1 = ttng.warp_group_dot %a, %b, %c {inputPrecision = 0 : i32} : tensor<64x32xf32> * !ttg.memdesc<32x64xf32> -> tensor<64x64xf32, #mma>
%2 = ttng.warp_group_dot %1, %b, %c {inputPrecision = 0 : i32} : tensor<64x64xf32> * !ttg.memdesc<64x64xf32> -> tensor<64x64xf32, #mma1>
"""


def rows_beyond(ttgir: str) -> list[str]:
    """Products of whole groups of warps (Hopper's) whose warps have more rows than there are."""
    rows = {}
    for name, warps, height in re.findall(
        r"#(mma\d*) = #ttg.nvidia_mma<{versionMajor = 3,.*?warpsPerCTA = \[(\d+), \d+\], instrShape = \[(\d+),", ttgir
    ):
        rows[name] = int(warps) * int(height)
    products = re.findall(r"warp_group_dot .*-> tensor<(\d+)x\d+xf32, #(mma\d*)>", ttgir)
    assert bool(products) == ("warp_group_dot " in ttgir)
    return [f"{name}: {rows[name]} rows of {height}" for height, name in products if rows[name] > int(height)]
