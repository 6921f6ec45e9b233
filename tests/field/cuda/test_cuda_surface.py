import copy

import pytest
import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import cuda, reference
from mmsynth.field.surface import Surface


def _surface(device: str, hidden: int, extent: float) -> Surface:
    """Dense and hashed levels, more than are looked up together."""
    surface = Surface(HashGrid(6, 8, 3, 60, extent), hidden, (0.5, 1.5)).to(device)
    torch.nn.init.normal_(surface.grid.table)
    torch.nn.init.normal_(surface.output_weight)
    return surface


def _positions(count: int, grid: HashGrid) -> Tensor:
    """Places of which some are outside, none within rounding of a cell's face, where the slope jumps."""
    x = (2.2 * torch.rand(2 * count, 3) - 1.1) * grid.extent
    scaled = (x.double() * (0.5 / grid.extent) + 0.5)[..., None] * grid.resolutions.cpu()
    return x[((scaled - scaled.round()).abs() > 1e-4).all(-1).all(-1)][:count]


def _gradients(value: Tensor, gradient: Tensor, surface: Surface, positions: Tensor) -> dict[str, Tensor]:
    value.backward(gradient.to(value))
    found = {"positions": positions, "hidden": surface.hidden, "output": surface.output_weight, "table": surface.grid.table}
    return {name: parameter.grad.double() for name, parameter in found.items()}


def _assert_near(found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    for name, value in expected.items():
        assert (found[name] - value).abs().max() < tolerance * (1e-3 + value.abs().max()), name


@pytest.mark.parametrize(("hidden", "active", "extent"), [(32, 6, 1.0), (20, 5, 2.0), (4, 0, 1.0)])
def test_surface_value_equals_the_network_with_all_gradients(device: str, hidden: int, active: int, extent: float) -> None:
    surface = _surface(device, hidden, extent)
    exact = copy.deepcopy(surface).double()
    x = _positions(70, surface.grid).to(device).requires_grad_()
    y = x.detach().double().requires_grad_()
    found, expected = cuda.surface_value(x, *surface.at(active)), reference.surface_value(y, *exact.at(active))
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), expected, atol=6e-5, rtol=0)  # float32 cell fractions at 60 cells
    gradient = torch.randn(len(x), device=device)
    if not active:
        surface.grid.table.grad = torch.zeros_like(surface.grid.table)
        exact.grid.table.grad = torch.zeros_like(exact.grid.table)
    _assert_near(_gradients(found, gradient, surface, x), _gradients(expected, gradient, exact, y), 1e-4)
    with torch.no_grad():
        again = cuda.surface_value(x, *surface.at(active))
        assert torch.equal(found, again) and not again.requires_grad
        assert cuda.surface_value(x[:0], *surface.at(active)).shape == (0,)


def _four_taps(positions: Tensor, epsilon: Tensor, surface: Surface, active: int) -> Tensor:
    """The definition, for sizes that differ."""
    taps = positions.new_tensor([[1.0, -1.0, -1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, 1.0, 1.0]])
    shifted = positions[:, None] + taps * (epsilon / 3**0.5)[:, None, None]
    values = reference.surface_value(shifted.reshape(-1, 3), *surface.at(active)).reshape(-1, 4)
    return (values @ taps) * (3**0.5 / (4 * epsilon))[:, None]


@pytest.mark.parametrize("sizes", ["one", "some none"])
def test_surface_gradient_equals_differences_with_all_gradients(device: str, sizes: str) -> None:
    surface = _surface(device, 20, 2.0)
    exact = copy.deepcopy(surface).double()
    x = _positions(20, surface.grid).to(device).requires_grad_()
    y = x.detach().double().requires_grad_()
    epsilon = torch.full((len(x),), 0.05, device=device) if sizes == "one" else 0.02 + 0.1 * torch.rand(len(x), device=device)
    asked = torch.arange(len(x), device=device) % 3 > 0 if sizes == "some none" else torch.ones(len(x), dtype=torch.bool, device=device)
    found = cuda.surface_gradient(x, 0.05 if sizes == "one" else torch.where(asked, epsilon, 0.0), *surface.at(5))
    expected = torch.where(asked[:, None], _four_taps(y, epsilon.double(), exact, 5), 0.0)
    assert found.shape == (len(x), 3)
    torch.testing.assert_close(found.double(), expected, atol=5e-3, rtol=1e-4)  # 1 / epsilon times the rounding of a value
    gradient = torch.randn_like(found)
    fast, slow = _gradients(found, gradient, surface, x), _gradients(expected, gradient, exact, y)
    # a tap within rounding of a cell's face may fall either way
    off = (fast["positions"] - slow["positions"]).abs().amax(1) > 1e-3 * (1 + slow["positions"].abs().amax(1))
    assert off.double().mean() < 0.05
    _assert_near({**fast, "positions": slow["positions"]}, slow, 1e-3)
    assert not fast["positions"][~asked].any()


def test_gradients_of_tables_are_added_and_frozen_ones_stay(device: str) -> None:
    surface = _surface(device, 8, 1.0)
    x = _positions(40, surface.grid).to(device)
    cuda.surface_value(x, *surface.at(6)).sum().backward()
    once = surface.grid.table.grad.clone()
    cuda.surface_value(x, *surface.at(6)).sum().backward()
    torch.testing.assert_close(surface.grid.table.grad, 2 * once, atol=1e-4, rtol=1e-4)
    surface.grid.table.grad = None
    surface.grid.table.requires_grad_(False)
    cuda.surface_value(x, *surface.at(6)).sum().backward()
    assert surface.grid.table.grad is None


def test_weights_have_the_same_bits_again(device: str) -> None:
    surface = _surface(device, 32, 1.0)
    x = _positions(70, surface.grid).to(device)
    bits = []
    for _ in range(2):
        surface.zero_grad()
        cuda.surface_value(x, *surface.at(6)).sin().sum().backward()
        bits.append([surface.hidden.grad.clone(), surface.output_weight.grad.clone()])
    assert all(torch.equal(a, b) for a, b in zip(*bits, strict=True))


def test_not_a_number_is_not_hidden(device: str) -> None:
    surface = _surface(device, 8, 1.0)
    x = _positions(40, surface.grid).to(device)
    x[5, 1] = torch.nan
    value = cuda.surface_value(x, *surface.at(6))
    assert value.isnan().nonzero().flatten().tolist() == [5]
    value.sum().backward()
    assert surface.hidden.grad.isnan().any()
    assert kernels.surface_value(x.double(), *surface.double().at(6)).isnan().sum() == 1
