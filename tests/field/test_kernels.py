"""The fast kernels against the torch reference: values and gradients."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mmsynth.field.kernels import OUTSIDE, SHELL, SOLID, accumulate, cpu, reference


@pytest.mark.parametrize("active", [0, 1, 3, 6])
def test_hash_encode_equals_reference(active: int) -> None:
    torch.manual_seed(0)
    resolutions = torch.tensor([3, 5, 9, 17, 40, 300])  # dense and hashed levels
    offsets = torch.tensor([0, 64, 280, 536, 792, 1048, 1304])
    tables = torch.randn(1304, 2, requires_grad=True)
    positions = torch.cat([torch.rand(700, 3), torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 0.5]])])
    gradient = torch.randn(703, 12)
    fast = cpu.hash_encode(positions, tables, resolutions, offsets, active)
    (fast_gradient,) = torch.autograd.grad(fast, tables, gradient)
    slow = reference.hash_encode(positions.double(), tables.double(), resolutions, offsets, active)
    torch.testing.assert_close(fast.double(), slow, atol=3e-4, rtol=0)  # float32 cell fractions at 300 cells
    if active:
        (slow_gradient,) = torch.autograd.grad(slow, tables, gradient.double())
        torch.testing.assert_close(fast_gradient, slow_gradient, atol=2e-3, rtol=0)
    assert not fast[:, 2 * active :].any()


def test_hash_encode_reference_gradient() -> None:
    tables = torch.randn(128, 2, dtype=torch.float64, requires_grad=True)
    levels = torch.tensor([3, 9]), torch.tensor([0, 64, 128])
    positions = torch.rand(5, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda t: reference.hash_encode(positions, t, *levels, 2), tables)


def test_dense_level_is_trilinear_interpolation() -> None:
    from scipy.interpolate import RegularGridInterpolator

    n = 4
    values = np.random.default_rng(0).normal(size=(n + 1, n + 1, n + 1, 2))
    table = torch.from_numpy(values.reshape(-1, 2)).float()
    points = np.random.default_rng(1).random((50, 3))
    expected = RegularGridInterpolator((np.arange(n + 1) / n,) * 3, values)(points)
    found = cpu.hash_encode(torch.from_numpy(points).float(), table, torch.tensor([n]), torch.tensor([0, (n + 1) ** 3]), 1)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)


def _rays(count: int) -> tuple[torch.Tensor, ...]:
    torch.manual_seed(1)
    origins = torch.nn.functional.normalize(torch.randn(count, 3), dim=1) * 2.5
    directions = torch.nn.functional.normalize(0.3 * torch.randn(count, 3) - origins, dim=1)
    return origins, directions, torch.full((count,), 1.3), torch.full((count,), 3.7), torch.rand(count)


def test_march_equals_reference() -> None:
    rays = _rays(300)
    states = torch.randint(0, 40, (16, 16, 16))
    states = torch.where(states > 20, SHELL, torch.where(states == 3, SOLID, OUTSIDE)).to(torch.uint8)
    fast, slow = cpu.march(*rays, states, 0.011), reference.march(*rays, states, 0.011)
    assert len(fast[0]) == pytest.approx(len(slow[0]), abs=3)  # a sample within rounding of a cell's face may fall either way
    same = fast[2].diff() == slow[2].diff()
    assert same.float().mean() > 0.98
    full = torch.ones_like(states)
    fast, slow = cpu.march(*rays, full, 0.011), reference.march(*rays, full, 0.011)
    torch.testing.assert_close(fast[0], slow[0])
    assert torch.equal(fast[1], slow[1]) and torch.equal(fast[2], slow[2])


def test_march_axis_parallel_and_empty_rays() -> None:
    states = torch.ones(4, 4, 4, dtype=torch.uint8)
    states[2] = OUTSIDE
    origins = torch.tensor([[-2.0, 0.1, 0.1], [0.1, -2.0, 0.1], [0.0, 0.0, 5.0]])
    directions = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    near, far = torch.tensor([1.0, 1.0, 0.0]), torch.tensor([3.0, 3.0, 0.0])
    for backend in (cpu, reference):
        t, _, offsets = backend.march(origins, directions, near, far, torch.full((3,), 0.5), states, 0.1)
        assert offsets.diff().tolist() == [15, 0, 0]  # the first ray crosses three of four slabs, the second lies in the empty one
        assert not (((t > 2.0) & (t < 2.5)).any())


def test_section_weights_equal_reference_with_gradient() -> None:
    torch.manual_seed(2)
    offsets = torch.tensor([0, 5, 5, 6, 40, 100])
    sdf = torch.randn(100) * 0.1
    gradient = torch.randn(100)
    for sharpness in (1.0, 30.0, 500.0):
        a = sdf.clone().requires_grad_()
        weights, crossing = cpu.section_weights(a, sharpness, offsets)
        weights.backward(gradient)
        b = sdf.double().requires_grad_()
        expected, expected_crossing = reference.section_weights(b, sharpness, offsets)
        expected.backward(gradient.double())
        torch.testing.assert_close(weights.double(), expected, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(crossing.double(), expected_crossing, atol=1e-6, rtol=0)
        torch.testing.assert_close(a.grad.double(), b.grad, atol=1e-5 * sharpness, rtol=1e-4)


def test_section_weights_reference_gradcheck() -> None:
    offsets = torch.tensor([0, 4, 9])
    sdf = torch.linspace(0.2, -0.2, 9, dtype=torch.float64).roll(3).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: reference.section_weights(f, 20.0, offsets)[0], sdf)


@settings(max_examples=40, deadline=None)
@given(st.floats(1.0, 2000.0), st.floats(-0.5, 0.5), st.integers(2, 60))
def test_falling_sdf_has_the_closed_form_opacity(sharpness: float, end: float, count: int) -> None:
    """Along a monotonically falling sdf the opacity telescopes to 1 - Φ(s f_end) / Φ(s f_start), however it is cut."""
    sdf = torch.linspace(0.6, end, count)
    weights, _ = cpu.section_weights(sdf, sharpness, torch.tensor([0, count]))
    logistic = lambda f: 1.0 / (1.0 + np.exp(-np.clip(sharpness * f, -700, 700)))
    assert float(weights.sum()) == pytest.approx(1 - logistic(float(sdf[-1])) / logistic(float(sdf[0])), abs=2e-5)


def test_accumulate_is_a_sum_per_ray() -> None:
    weights, values, ray = torch.rand(7), torch.randn(7, 3), torch.tensor([0, 0, 2, 2, 2, 3, 3])
    expected = torch.stack([(weights[:, None] * values)[ray == r].sum(0) for r in range(5)])
    torch.testing.assert_close(accumulate(weights, values, ray, 5), expected)
