"""The Triton kernels against the torch reference: on a GPU where there is one, and in Triton's interpreter on the CPU.

Whether Triton compiles or interprets is decided when it is first imported. So the interpreter gets a process of its own, where
this file runs a second time, with TRITON_INTERPRET=1 and CPU tensors in the place of CUDA tensors.
"""

import importlib
import importlib.util
import os
import subprocess
import sys
from types import ModuleType

import pytest
import torch

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import OUTSIDE, SHELL, SOLID, Rays, Sampling, cpu, cuda, reference
from mmsynth.field.kernels.constants import LEAST_ADVANCE, MAX_SAMPLES_PER_RAY
from mmsynth.field.kernels.cuda import encoding, marching, sections, shared
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.rendering import FARTHEST, ball_interval
from mmsynth.field.surface import Surface

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
needs_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")
once = pytest.mark.skipif(INTERPRETED, reason="has nothing to do with the interpreter")
on_gpu = (pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"))

if INTERPRETED:
    # the interpreter of triton 3.6 takes int() of arrays of one element for the bounds of a loop; numpy 2.4 has no such thing
    from triton.runtime import interpreter

    patch_tensor = interpreter._patch_lang_tensor

    def patch_tensor_and_index(tensor: object, scope: interpreter._LangPatchScope) -> None:
        patch_tensor(tensor, scope)
        scope.set_attr(tensor, "__index__", lambda self: int(self.handle.data.item()))

    interpreter._patch_lang_tensor = patch_tensor_and_index


@pytest.fixture(params=["cpu" if INTERPRETED else pytest.param("cuda", marks=on_gpu)])
def device(request: pytest.FixtureRequest) -> str:
    torch.manual_seed(0)
    return request.param


@once
@needs_triton
@pytest.mark.slow
def test_values_in_the_interpreter() -> None:
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", __file__]
    run = subprocess.run(command, env=os.environ | {"TRITON_INTERPRET": "1"}, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-5000:] + run.stderr[-2000:]
    assert "passed" in run.stdout


def _module_without_triton(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setitem(sys.modules, "triton", None)  # an import of it now fails
    spec = importlib.util.spec_from_file_location("cuda_without_triton", shared.__file__)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@once
def test_imports_without_triton_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _module_without_triton(monkeypatch).available() == (False, "triton is not installed")


@once
def test_availability_has_a_reason_of_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    can, why = cuda.available()
    assert can is (why == "") and "\n" not in why
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(shared, "triton", object())
    assert cuda.available() == (False, "torch sees no CUDA device")


@once
def test_a_broken_toolchain_is_a_reason_not_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise RuntimeError("Failed to find C compiler.\nPlease specify one.")

    monkeypatch.setattr(torch, "zeros", fail)
    assert shared._probe.__wrapped__() == (False, "no triton kernel can be run: Failed to find C compiler.")


class _OnGpu:
    """What the choice of a backend asks a tensor."""

    def __init__(self, dtype: torch.dtype) -> None:
        self.device, self.dtype = torch.device("cuda"), dtype


@once
@pytest.mark.parametrize("can", [True, False])
def test_the_backend_follows_the_tensor_and_what_is_missing_is_said_once(
    can: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cuda, "available", lambda: (True, "") if can else (False, "no compiler"))
    kernels._on_gpu.cache_clear()
    try:
        assert [kernels._backend(_OnGpu(torch.float32)) for _ in range(3)] == [cuda if can else reference] * 3
        assert capsys.readouterr().err == ("" if can else "GPU kernels unavailable (no compiler): using torch operations\n")
        assert kernels._backend(_OnGpu(torch.float64)) is kernels._backend(torch.ones(1).double()) is reference
        assert kernels._backend(torch.ones(1)) is cpu
    finally:
        kernels._on_gpu.cache_clear()


# dense and hashed levels, one more than a program does, as in test_kernels
RESOLUTIONS, OFFSETS = [3, 5, 9, 17, 40, 300], [0, 64, 280, 536, 792, 1048, 1304]
CORNERS = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 0.5]]


def _grid(device: str, features: int, levels: int = 6) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    positions = torch.cat([torch.rand(197, 3), torch.tensor(CORNERS)]).to(device)
    table = torch.randn(OFFSETS[levels], features).to(device)
    return positions, table, torch.tensor(RESOLUTIONS[:levels], device=device), torch.tensor(OFFSETS[: levels + 1], device=device)


@pytest.mark.parametrize(("active", "features"), [(0, 2), (1, 4), (3, 2), (6, 2), (6, 4), (9, 2)])
def test_hash_encode_equals_reference_with_both_gradients(device: str, active: int, features: int) -> None:
    positions, table, *levels = _grid(device, features)
    fast_inputs = positions.clone().requires_grad_(), table.clone().requires_grad_()
    slow_inputs = positions.double().requires_grad_(), table.double().requires_grad_()
    fast = cuda.hash_encode(*fast_inputs, *levels, active)
    slow = reference.hash_encode(*slow_inputs, *levels, active)
    assert fast.dtype == torch.float32 and fast.shape == slow.shape
    torch.testing.assert_close(fast.double(), slow, atol=3e-4, rtol=0)  # float32 cell fractions at 300 cells
    assert not fast[:, active * features :].any()
    gradient = torch.randn_like(fast)
    gradient[::3] = 0  # skipped
    gradient[1, : 2 * features] = 0
    fast_gradients = torch.autograd.grad(fast, fast_inputs, gradient)
    slow_gradients = [torch.zeros_like(x) for x in slow_inputs]
    if active:
        slow_gradients = torch.autograd.grad(slow, slow_inputs, gradient.double())
    torch.testing.assert_close(fast_gradients[0].double(), slow_gradients[0], atol=6e-2, rtol=0)  # of up to 2000; fractions, as above
    torch.testing.assert_close(fast_gradients[1].double(), slow_gradients[1], atol=1e-3, rtol=0)


@pytest.mark.parametrize(("resolution", "rows"), [(4, 125), (4, 128), (5, 128), (700, 256)])
def test_one_level(device: str, resolution: int, rows: int) -> None:
    """Dense when (resolution + 1)³ fits, to the row."""
    positions, table = torch.cat([torch.rand(50, 3), torch.tensor(CORNERS)]).to(device), torch.randn(rows, 2).to(device)
    level = torch.tensor([resolution], device=device), torch.tensor([0, rows], device=device)
    fast = cuda.hash_encode(positions, table, *level, 1)
    torch.testing.assert_close(fast.double(), reference.hash_encode(positions.double(), table.double(), *level, 1), atol=1e-3, rtol=0)


def test_linear_functions_are_exact_and_so_is_their_slope(device: str) -> None:
    n = 8
    axis = torch.arange(n + 1, device=device) / n
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    table = torch.stack([2 * x - y, x + 3 * z], -1).reshape(-1, 2).contiguous()
    positions = torch.cat([torch.rand(40, 3), torch.tensor(CORNERS)]).to(device).requires_grad_()
    out = cuda.hash_encode(positions, table, torch.tensor([n], device=device), torch.tensor([0, (n + 1) ** 3], device=device), 1)
    px, py, pz = positions.detach().unbind(1)
    torch.testing.assert_close(out, torch.stack([2 * px - py, px + 3 * pz], -1), atol=2e-6, rtol=0)
    (slope,) = torch.autograd.grad(out[:, 0].sum() + out[:, 1].sum(), positions)
    torch.testing.assert_close(slope, torch.tensor([[3.0, -1.0, 3.0]], device=device).expand(43, 3), atol=2e-5, rtol=0)


def test_hash_encode_reads_a_slice_of_wider_gradients(device: str) -> None:
    """What the encoding gets from a network whose input is concatenated with the position; also a column-major one."""
    positions, table, *levels = _grid(device, 2)
    table.requires_grad_()
    wide = torch.randn(len(positions), 15, device=device)
    (expected,) = torch.autograd.grad(cuda.hash_encode(positions, table, *levels, 6), table, wide[:, 3:].contiguous())
    for gradient in (wide[:, 3:], wide[:, 3:].T.contiguous().T):
        (found,) = torch.autograd.grad(cuda.hash_encode(positions, table, *levels, 6), table, gradient)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


def test_hash_encode_of_nothing(device: str) -> None:
    _, table, *levels = _grid(device, 2)
    positions, table = torch.empty(0, 3, device=device, requires_grad=True), table.requires_grad_()
    out = cuda.hash_encode(positions, table, *levels, 6)
    assert out.shape == (0, 12)
    to_positions, to_table = torch.autograd.grad(out.sum(), (positions, table))
    assert to_positions.shape == (0, 3) and not to_table.any()


def test_not_a_number_stays_in_its_sample(device: str) -> None:
    positions, table, *levels = _grid(device, 2)
    table.requires_grad_()
    positions[7, 1] = torch.nan
    out = cuda.hash_encode(positions, table, *levels, 6)
    assert out[7].isnan().all() and out.isnan().any(1).sum() == 1
    gradient = torch.zeros_like(out)
    gradient[3, 0] = torch.nan
    assert torch.autograd.grad(out, table, gradient)[0].isnan().any()
    sdf = torch.tensor([0.1, torch.nan, -0.1, 0.1, -0.1], device=device)
    weights, _ = cuda.section_weights(sdf, 30.0, torch.tensor([0, 3, 5], device=device))
    assert weights[:2].isnan().all() and not weights[2:].isnan().any()


# rays of 0, 1 and 2 samples, one that fills a step exactly, one longer than a step, one longer than two
COUNTS = [5, 0, 1, 2, 32, 33, 0, 70, 1]


@pytest.mark.parametrize(("sharpness", "scale"), [(1.0, 0.1), (30.0, 0.1), (500.0, 0.1), (1e6, 0.1), (123456.789, 1e-5), (1e6, 1e-6)])
def test_section_weights_equal_reference_with_gradient(device: str, sharpness: float, scale: float) -> None:
    offsets = torch.tensor([0, *COUNTS], device=device).cumsum(0)
    sdf = (torch.randn(int(offsets[-1])) * scale).to(device)
    sdf[2], sdf[40] = 0.0, sdf[39]  # on the surface, and a section along it
    gradient = torch.randn_like(sdf)
    a, b = sdf.clone().requires_grad_(), sdf.double().requires_grad_()
    weights, crossing = cuda.section_weights(a, sharpness, offsets)
    expected, expected_crossing = reference.section_weights(b, sharpness, offsets)
    torch.testing.assert_close(weights.double(), expected, atol=2e-7, rtol=1e-6)
    torch.testing.assert_close(crossing.double(), expected_crossing, atol=2e-7, rtol=0)
    assert not weights[offsets[1:][offsets.diff() > 0] - 1].any()
    (fast,) = torch.autograd.grad(weights, a, gradient)
    (slow,) = torch.autograd.grad(expected, b, gradient.double())
    torch.testing.assert_close(fast.double(), slow, atol=1e-6 * sharpness, rtol=1e-5)


def test_smooth_rays_have_weights_and_gradients_to_float32(device: str) -> None:
    """A surface that is approached slowly: sections with an optical depth below and above where the series end."""
    sdf, offsets = torch.linspace(0.4, -0.05, 120, device=device), torch.tensor([0, 120], device=device)
    a, b = sdf.clone().requires_grad_(), sdf.double().requires_grad_()
    weights, _ = cuda.section_weights(a, 60.0, offsets)
    expected, _ = reference.section_weights(b, 60.0, offsets)
    torch.testing.assert_close(weights.double(), expected, atol=0, rtol=2e-7)
    gradient = torch.randn(120, device=device)
    (fast,), (slow,) = torch.autograd.grad(weights, a, gradient), torch.autograd.grad(expected, b, gradient.double())
    torch.testing.assert_close(fast.double(), slow, atol=1e-9, rtol=2e-6)


def test_section_weights_without_samples(device: str) -> None:
    for rays in (0, 3):
        sdf = torch.empty(0, device=device, requires_grad=True)
        weights, crossing = cuda.section_weights(sdf, 10.0, torch.zeros(rays + 1, dtype=torch.int64, device=device))
        assert weights.shape == crossing.shape == (0,)
        assert torch.autograd.grad(weights.sum(), sdf)[0].shape == (0,)


@pytest.mark.parametrize(("hidden", "active", "extent"), [(32, 6, 1.0), (32, 4, 2.0), (20, 6, 1.0), (4, 0, 1.0)])
def test_surface_value_equals_the_network(device: str, hidden: int, active: int, extent: float) -> None:
    surface = Surface(HashGrid(6, 8, 3, 300, extent), hidden, (0.5, 1.5)).to(device)
    torch.nn.init.normal_(surface.grid.table)
    torch.nn.init.normal_(surface.output_weight)
    positions = (2.2 * torch.rand(200, 3, device=device) - 1.1) * extent  # some are outside
    with torch.no_grad():
        found = cuda.surface_value(positions, *surface.at(active))
    expected = reference.surface_value(positions.double(), *surface.double().at(active))
    torch.testing.assert_close(found.double(), expected, atol=1e-3, rtol=0)  # float32 cell fractions at 300 cells
    assert not found.requires_grad
    with torch.no_grad():
        assert cuda.surface_value(positions[:0], *surface.float().at(active)).shape == (0,)


FIELDS = {
    "sphere": lambda x: torch.linalg.vector_norm(x, dim=-1) - 0.5,
    "waves": lambda x: torch.linalg.vector_norm(x, dim=-1) - 0.6 + 0.05 * torch.sin(20 * x).sum(-1),
    "never": lambda x: 0.04 + 0 * x[:, 0],
    "inside": lambda x: -0.04 + 0 * x[:, 0],
    "nan": lambda x: torch.where(x[:, 0] > 0.1, torch.nan, 0.04 + 0 * x[:, 0]),
}


def _states(kind: str, extent: float) -> torch.Tensor:
    """Three-state grid: true to the sphere, or as it comes."""
    if kind == "open":
        return torch.full((16,) * 3, SHELL, dtype=torch.uint8)
    if kind == "random":
        states = torch.randint(0, 60, (16,) * 3)
        return torch.where(states > 25, SHELL, torch.where(states == 3, SOLID, OUTSIDE + states // 8)).to(torch.uint8)
    axis = ((torch.arange(24) + 0.5) / 12 - 1) * extent
    free = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).square().sum(0).sqrt() - 0.5
    margin = extent * 3**0.5 / 24 + 0.06
    return torch.where(free > margin, OUTSIDE + (free - margin) * 24 / extent, torch.where(free < -margin, SOLID, SHELL)).to(torch.uint8)


def _rays(count: int, extent: float, device: str) -> list[torch.Tensor]:
    """Rays that hit and miss the unit ball, that begin in it, and along an axis; origins, directions, near, far, jitter."""
    origins = torch.nn.functional.normalize(torch.randn(count, 3), dim=1) * 2.5
    directions = torch.nn.functional.normalize(0.4 * torch.randn(count, 3) - origins / 2.5, dim=1)
    origins[:4] *= 0.1
    directions[4:7] = -torch.eye(3)
    origins[4:7] = 2.0 * torch.eye(3) + 0.05
    directions[7] *= -1
    near, far = ball_interval(origins, directions) if extent == 1.0 else (torch.zeros(count), torch.full((count,), FARTHEST))
    return [x.to(device) for x in (origins, directions, near, far, torch.rand(count))]


@pytest.mark.parametrize(
    ("field", "states", "step", "extent"),
    [("sphere", "true", 0.02, 1.0), ("sphere", "true", 0.05, 2.0), ("sphere", "open", 0.05, 2.0), ("waves", "random", 0.03, 1.0),
     ("waves", "random", 0.06, 2.0), ("never", "random", 0.002, 1.0), ("inside", "open", 0.05, 1.0), ("nan", "random", 0.05, 1.0)],
)  # fmt: skip
def test_march_equals_reference(device: str, field: str, states: str, step: float, extent: float) -> None:
    rays, grid = _rays(50, extent, device), _states(states, extent).to(device)
    sampling = Sampling(sharpness=60.0, step=step, active_surface=1, active_radiance=1, max_optical_depth=2.0)
    t, ray, offsets = cuda.march(FIELDS[field], Rays(*rays), grid, extent, sampling)
    t64, ray64, offsets64 = reference.march(FIELDS[field], Rays(*(x.double() for x in rays)), grid, extent, sampling)
    assert (t.dtype, ray.dtype, offsets.dtype) == (torch.float32, torch.int64, torch.int64)
    assert torch.equal(ray, torch.repeat_interleave(torch.arange(50, device=device), offsets.diff())) and offsets[0] == 0
    # a sample within rounding of a cell's face may fall either way, and with it the rest of its ray
    same = offsets.diff() == offsets64.diff()
    assert same.float().mean() > 0.97 and offsets.diff().max() > (95 if field == "never" else 3)
    error = ((t[same[ray]] - t64[same[ray64]]) / (1 + t64[same[ray64]])).abs()
    assert (error < 2e-5).float().mean() > 0.99, error.max()


def test_march_from_afar_comes_to_an_end(device: str) -> None:
    """A step is less than float32 resolves at the distance of the camera."""
    rays = [torch.tensor(x, device=device) for x in ([[0.0, 0.0, -5e4]], [[0.0, 0.0, 1.0]], [5e4 - 1], [5e4 + 1], [0.5])]
    states = torch.full((7, 7, 7), OUTSIDE, dtype=torch.uint8, device=device)
    states[:, :, 5:] = SHELL
    sampling = Sampling(sharpness=60.0, step=1e-4, active_surface=1, active_radiance=1)
    t, _, _ = cuda.march(FIELDS["sphere"], Rays(*rays), states, 1.0, sampling)
    assert len(t) and bool((t > 5e4 + 0.42).all())


def test_march_without_rays_and_without_hits(device: str) -> None:
    sampling = Sampling(sharpness=60.0, step=0.02, active_surface=1, active_radiance=1)
    for count in (0, 9):
        rays = _rays(max(count, 8), 1.0, device)
        empty = torch.full((4, 4, 4), OUTSIDE, dtype=torch.uint8, device=device)
        t, ray, offsets = cuda.march(FIELDS["sphere"], Rays(*(x[:count] for x in rays)), empty, 1.0, sampling)
        assert t.shape == ray.shape == (0,) and offsets.tolist() == [0] * (count + 1)


@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_a_trace_on_these_kernels(device: str, extent: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """March, surface, sections and encoding together, with the gradients of all parameters and of the rays."""
    if device == "cpu":
        monkeypatch.setattr(kernels, "_backend", lambda tensor: cuda if tensor.dtype == torch.float32 else reference)
    surface, appearance = Surface(HashGrid(3, 8, 3, 12, extent), 8, (0.5, 1.7 * extent)), HashGrid(2, 8, 3, 9, extent)
    torch.nn.init.normal_(surface.grid.table, std=0.1)
    torch.nn.init.normal_(surface.output_weight, std=0.1)
    torch.nn.init.normal_(appearance.table)
    occupancy = Occupancy(16, extent)
    occupancy.states.copy_(torch.where(torch.rand(16, 16, 16) < 0.3, OUTSIDE, SHELL))
    rays = _rays(24, extent, device)
    sampling = Sampling(sharpness=20.0, step=0.1, active_surface=3, active_radiance=2)
    found = []
    for dtype in (torch.float32, torch.float64):
        for module in (surface, appearance, occupancy):
            module.to(device, dtype)
        inputs = [x.to(dtype) for x in rays]
        leaves = [*surface.parameters(), appearance.table, *(x.requires_grad_() for x in inputs[:2])]
        hits = kernels.trace(*surface.at(3), appearance.at(2), occupancy.states, Rays(*inputs), sampling)
        loss = hits.features.square().sum() + (hits.opacity * torch.arange(24, device=device)).sum()
        found.append([x.detach() for x in (hits.features, hits.opacity, hits.depth, *torch.autograd.grad(loss, leaves))])
        assert hits.samples > 50
    for fast, slow in zip(*found, strict=True):
        torch.testing.assert_close(fast.double(), slow, atol=2e-3 * (1 + float(slow.nan_to_num().abs().max())), rtol=0, equal_nan=True)
        assert slow.nan_to_num().any()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_many_samples_on_the_gpu() -> None:
    """Many programs at once, and many additions to one row."""
    torch.manual_seed(0)
    resolutions, offsets = torch.tensor([16, 32, 64, 128, 256]).cuda(), torch.tensor([0, 4913, 37681, 70449, 103217, 135985]).cuda()
    table, positions = torch.randn(135985, 2).cuda().requires_grad_(), torch.rand(300_001, 3).cuda().requires_grad_()
    fast = cuda.hash_encode(positions, table, resolutions, offsets, 5)
    slow = reference.hash_encode(positions.double(), table.double(), resolutions, offsets, 5)
    torch.testing.assert_close(fast.double(), slow, atol=5e-4, rtol=0)
    gradient = torch.randn_like(fast)
    fast_gradients = torch.autograd.grad(fast, (positions, table), gradient)
    slow_gradients = torch.autograd.grad(slow, (positions, table), gradient.double())
    torch.testing.assert_close(fast_gradients[1], slow_gradients[1], atol=1e-2, rtol=1e-4)
    apart = (fast_gradients[0] - slow_gradients[0]).abs().amax(1)
    assert (apart > 1.0).float().mean() < 1e-3  # a position within rounding of a cell's face may fall either way
    counts = torch.randint(0, 150, (20_000,)).cuda()
    rays = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    sdf = (0.1 * torch.randn(int(rays[-1]), device="cuda")).requires_grad_()
    weights, _ = cuda.section_weights(sdf, 200.0, rays)
    expected, _ = reference.section_weights(sdf.double(), 200.0, rays)
    torch.testing.assert_close(weights.double(), expected, atol=1e-6, rtol=1e-5)
    (found,), (wanted,) = torch.autograd.grad(weights.square().sum(), sdf), torch.autograd.grad(expected.square().sum(), sdf)
    torch.testing.assert_close(found, wanted, atol=2e-3, rtol=1e-3)


F32, I64, I32 = "*fp32", "*i64", "i32"
GRID, SIZES = {"resolutions": I64, "offsets": I64}, {"FEATURES": 4, "BLOCK": encoding.BLOCK}
RAYS = {"RAYS": sections._RAYS, "SAMPLES": sections._SAMPLES}
LANES = {"lanes": I64, "sdf": F32, "origins": F32, "directions": F32, "fars": F32, "jitters": F32, "states": "*u8", "memory": F32}
STEP = dict.fromkeys(["half", "extent", "step", "skip", "sphere_step_factor", "soft", "min_slope", "max_optical_depth"], "fp32") | {
    "sharpness": "fp64"
}
SIGNATURES: dict[str, tuple[dict[str, str], dict[str, float]]] = {
    "encoding.encode_kernel": (
        {"positions": F32, "table": F32, **GRID, "out": F32, "count": I32, "levels": I32, "active": I32},
        SIZES | {"LEVELS": encoding._LEVELS},
    ),
    "encoding.encode_backward_kernel": (
        {"positions": F32, "gradient": F32, "stride": I32, **GRID, "out": F32, "count": I32, "active": I32},
        SIZES | {"LEVELS": encoding._LEVELS},
    ),
    "encoding.encode_positions_backward_kernel": (
        {"positions": F32, "table": F32, "gradient": F32, "stride": I32, **GRID, "out": F32, "count": I32, "active": I32},
        SIZES,
    ),
    "sections.sections_kernel": ({"sdf": F32, "sharpness": "fp64", "offsets": I64, "weights": F32, "crossing": F32, "rays": I32}, RAYS),
    "sections.sections_backward_kernel": (
        {"sdf": F32, "sharpness": "fp64", "offsets": I64, "gradient": F32, "out": F32, "rays": I32}, RAYS,
    ),
    "surface.surface_kernel": (
        {"positions": F32, "scale": "fp32", "inner": "fp32", "outer": "fp32", "table": F32, **GRID, "weight": F32, "last": F32, "out": F32,
         "count": I32, "active": I32},
        {"UNITS": 32, **SIZES, "HIDDEN": 32},
    ),
    "marching.round_kernel": (
        {**LANES, "found": F32, "counts": I64, "where": F32, "alive": "*u8", "count": I32, "rays": I32, "k": I32, "grid": I32, **STEP},
        {"MAX_SAMPLES_PER_RAY": MAX_SAMPLES_PER_RAY, "LEAST_ADVANCE": LEAST_ADVANCE, "CONTRACTED": 1, "LANES": marching._LANES},
    ),
}  # fmt: skip


@once
@needs_triton
@pytest.mark.parametrize("name", SIGNATURES)
def test_compiles_for_hopper(name: str, tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """To machine code of the H100, without one: the interpreter accepts more than the compiler does."""
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    arguments, constants = SIGNATURES[name]
    module, kernel = name.split(".")
    kernel = getattr(importlib.import_module(f"{cuda.__name__}.{module}"), kernel)
    assert kernel.arg_names == [*arguments, *constants]
    signature = arguments | dict.fromkeys(constants, "constexpr")
    aligned = {(i,): [["tt.divisibility", 16]] for i, kind in enumerate(arguments.values()) if kind.startswith("*")}
    source = ASTSource(kernel, signature, {(kernel.arg_names.index(k),): v for k, v in constants.items()}, aligned)
    compiled = triton.compile(source, target=GPUTarget("cuda", 90, 32))
    assert compiled.asm["cubin"]
    if name.startswith("encoding"):  # the features of a row in one access
        assert "ld.global.v4.b32" in compiled.asm["ptx"] or "add.v4.f32" in compiled.asm["ptx"]
