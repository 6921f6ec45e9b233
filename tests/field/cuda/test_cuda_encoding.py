import pytest
import torch
from torch import Tensor

from mmsynth.field.kernels import cuda, reference

# dense and hashed levels, more than are looked up together, as in test_kernels
RESOLUTIONS, OFFSETS = [3, 5, 9, 17, 40, 300], [0, 64, 280, 536, 792, 1048, 1304]
CORNERS = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 0.5]]


def _grid(device: str, features: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    positions = torch.cat([torch.rand(97, 3), torch.tensor(CORNERS)]).to(device)
    table = torch.randn(OFFSETS[-1], features).to(device)
    return positions, table, torch.tensor(RESOLUTIONS, device=device), torch.tensor(OFFSETS, device=device)


@pytest.mark.parametrize(("active", "features"), [(0, 2), (1, 4), (6, 2), (5, 4), (9, 4)])
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


def test_a_slice_of_wider_gradients_is_read_as_it_is(device: str) -> None:
    """What the encoding gets from a network whose input is concatenated with the position; also a column-major one."""
    positions, table, *levels = _grid(device, 2)
    table.requires_grad_()
    wide = torch.randn(len(positions), 15, device=device)
    (expected,) = torch.autograd.grad(cuda.hash_encode(positions, table, *levels, 6), table, wide[:, 3:].contiguous())
    for gradient in (wide[:, 3:], wide[:, 3:].T.contiguous().T):
        (found,) = torch.autograd.grad(cuda.hash_encode(positions, table, *levels, 6), table, gradient)
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_tables_of_16_bits_are_read_as_they_are(device: str, dtype: torch.dtype) -> None:
    positions, table, *levels = _grid(device, 4)
    found = cuda.hash_encode(positions, table.to(dtype), *levels, 6)
    torch.testing.assert_close(found, cuda.hash_encode(positions, table.to(dtype).float(), *levels, 6), atol=0, rtol=0)


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
