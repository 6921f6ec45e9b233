"""What the Triton kernels share: the compiler, constants, small device functions, and whether they can run on this machine."""

from __future__ import annotations

import functools
import sys
from typing import Any

import torch
from torch import Tensor

from mmsynth.field.kernels import constants

try:
    import triton
    import triton.language as tl
except ImportError:
    triton = tl = None

_OLDEST = (3, 5)  # before it each thread got a result of its own of an atomic addition whose lanes several threads share
_LEAST = (8, 0)  # compute capability: the products are those of its tensor cores
_PROGRAMS_PER_CORE = 4  # of a persistent kernel, for each multiprocessor
# numbers that a kernel must not be compiled anew for where they happen to be 1 or multiples of 16
_PLAIN = [
    "count", "rays", "rows", "levels", "active", "grid", "width", "stride", "size", "bright", "bisections", "lamps", "asked", "drawn",
    "modalities", "key_0", "key_1", "key_2", "key_3", "tile_bisections", "frame_bisections",
]  # fmt: skip
# parts of arrays: where they begin in memory is as odd as the number of rays
_ANYWHERE = ["origins", "directions", "jitter", "loss", "total"]


def jit(function: Any) -> Any:
    """``triton.jit`` that compiles once, not anew for sizes and places that happen to be 1 or multiples of 16; a no-op without triton."""
    return function if triton is None else triton.jit(do_not_specialize=_PLAIN, do_not_specialize_on_alignment=_ANYWHERE)(function)


def constant(value: float) -> Any:
    """A number of ``kernels.constants`` that kernels may read."""
    return value if tl is None else tl.constexpr(value)


SOLID, OUTSIDE = constant(constants.SOLID), constant(constants.OUTSIDE)
ALONG_FACE, NO_CROSSING = constant(constants.ALONG_FACE), constant(constants.NO_CROSSING)
FACE_OVERSHOOT = constant(constants.FACE_OVERSHOOT)
LEAST_ADVANCE, LONGEST_STEP = constant(constants.LEAST_ADVANCE), constant(constants.LONGEST_STEP)
SOFT_SURFACE, LAYER_GAP, LN2 = (constant(x) for x in (constants.SOFT_SURFACE, constants.LAYER_GAP, constants.LN2))
MAX_SAMPLES = constant(constants.MAX_SAMPLES_PER_RAY)
STAGES = constant(constants.STAGES)
LEAST_WEIGHT = constant(constants.LEAST_WEIGHT)
FIRST_FEATURE_ROW = constant(constants.FIRST_FEATURE_ROW)
HASH_Y, HASH_Z = constant(constants.HASH_PRIMES[1]), constant(constants.HASH_PRIMES[2])
HUBER, MOSTLY_BLOCKED = constant(constants.HUBER_DELTA), constant(constants.MOSTLY_BLOCKED)
COLUMNS = constant(16)  # features that are looked up together, the least depth of a matrix product on tensor cores


def programs(device: torch.device, per_core: int = _PROGRAMS_PER_CORE) -> int:
    """Programs of a persistent kernel: sums of as many parts are added in order, so a result depends on the kind of GPU alone."""
    return 2 if device.type == "cpu" else per_core * torch.cuda.get_device_properties(device).multi_processor_count


def scalar(value: float | Tensor, device: torch.device) -> Tensor:
    """A number that kernels read from memory, float64 (): one that changes in a captured graph is a tensor already."""
    return value if isinstance(value, Tensor) else torch.full((), value, dtype=torch.float64, device=device)


@jit
def position(positions, i, live):  # type: ignore[no-untyped-def]
    x = tl.load(positions + 3 * i, mask=live, other=0.0)
    y = tl.load(positions + 3 * i + 1, mask=live, other=0.0)
    z = tl.load(positions + 3 * i + 2, mask=live, other=0.0)
    return x, y, z


@jit
def softplus(x):  # type: ignore[no-untyped-def]
    """log(1 + eˣ) and its slope. Triton has no log1p: below 1e-2 its series, exact to 2e-9 of the result."""
    e = tl.exp(-tl.abs(x))
    log1p = tl.where(e < 1e-2, e * (1.0 - e * (0.5 - e * (1.0 / 3.0 - e * 0.25))), tl.log(1.0 + e))
    return tl.where(x > 0.0, x, 0.0 * x) + log1p, tl.where(x > 0.0, 1.0, e) / (1.0 + e)


@jit
def sigmoid(x):  # type: ignore[no-untyped-def]
    e = tl.exp(-tl.abs(x))
    return tl.where(x >= 0.0, 1.0, e) / (1.0 + e)


@jit
def first_number(ray, of, count, bisections):  # type: ignore[no-untyped-def]
    """The first number of each ray or of those after it, by bisection: ``ray`` (count,) never decreases."""
    low = of * 0
    high = low + count
    for _ in range(0, bisections):
        middle = (low + high) // 2
        before = (low < high) & (tl.load(ray + middle, mask=low < high, other=0).to(tl.int32) < of)
        low, high = tl.where(before, middle + 1, low), tl.where(before, high, middle)
    return low


@jit
def sum_of_pair(values, PAIRS: tl.constexpr):  # type: ignore[no-untyped-def]
    """(2 PAIRS,) → the sum of neighbours, at both of them."""
    both = tl.sum(tl.reshape(values, (PAIRS, 2)), 1)
    return tl.reshape(tl.broadcast_to(both[:, None], (PAIRS, 2)), (2 * PAIRS,))


@jit
def contracted(x, y, z, CONTRACTED: tl.constexpr):  # type: ignore[no-untyped-def]
    """A position in the frame of the grid, and its distance from the centre before contraction, at least 1."""
    reach = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1.0)
    if CONTRACTED:
        factor = (2.0 - 1.0 / reach) / reach
        x, y, z = x * factor, y * factor, z * factor
    return x, y, z, reach


@jit
def back_to_world(x, y, z, gx, gy, gz, CONTRACTED: tl.constexpr):  # type: ignore[no-untyped-def]
    """Gradient to a position from the gradient to its contraction."""
    if CONTRACTED:
        r = tl.maximum(tl.sqrt(x * x + y * y + z * z), 1.0)
        factor = (2.0 - 1.0 / r) / r  # 1 where r is, and the change of it 0
        change = (2.0 - 2.0 * r) / (r * r * r * r) * (x * gx + y * gy + z * gz)
        gx, gy, gz = factor * gx + change * x, factor * gy + change * y, factor * gz + change * z
    return gx, gy, gz


@jit
def _one(out):  # type: ignore[no-untyped-def]
    tl.store(out, 1.0)


@functools.cache
def _probe() -> tuple[bool, str]:
    # Triton compiles its launcher with the machine's C compiler and Python's headers: only a launch tells whether they are there
    try:
        out = torch.zeros(1, device="cuda")
        _one[(1,)](out)
        return (True, "") if out.item() == 1.0 else (False, "a triton kernel ran, but its result is wrong")
    except Exception as error:  # whatever the compiler, the driver or torch raise: the torch operations do instead
        return False, "no triton kernel can be run: " + (str(error).strip() or type(error).__name__).splitlines()[0]


def available() -> tuple[bool, str]:
    """Whether the operations can run on this machine's GPU; if not, why: one line."""
    if triton is None:
        return False, "triton is not installed"
    if not torch.cuda.is_available():
        return False, "torch sees no CUDA device"
    if tuple(int(number) for number in triton.__version__.split(".")[:2]) < _OLDEST:
        return False, f"triton {triton.__version__} is older than {_OLDEST[0]}.{_OLDEST[1]}"
    if (capability := torch.cuda.get_device_capability()) < _LEAST:
        return False, f"a GPU of compute capability {capability[0]}.{capability[1]}, not {_LEAST[0]}.{_LEAST[1]} or later"
    return _probe()


_made: list[str] = []


def _note(*_: Any, repr: str = "", **__: Any) -> bool:
    """What Triton calls before it compiles a kernel, or loads one that it compiled before."""
    if not _made:
        print("preparing GPU kernels, the first time for a minute or more ...", file=sys.stderr, flush=True)
    _made.append(repr)
    return False  # go on


def made() -> int:
    """How many kernels were compiled or loaded until now, for each of which the host waited."""
    return len(_made)


if triton is not None and hasattr(triton, "knobs"):
    triton.knobs.runtime.jit_cache_hook = _note
