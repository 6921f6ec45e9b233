"""Adam over the named parameters of a field."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from mmsynth.fitting.optimiser import Adam


def _parameters(dtype: torch.dtype = torch.float32) -> dict[str, nn.Parameter]:
    torch.manual_seed(0)
    return {"a.table": nn.Parameter(torch.randn(50, 4, dtype=dtype)), "b": nn.Parameter(torch.randn(7, dtype=dtype))}


def _gradients(parameters: dict[str, nn.Parameter], step: int) -> None:
    generator = torch.Generator().manual_seed(step)
    for p in parameters.values():
        gradient = torch.randn(p.shape, generator=generator, dtype=p.dtype)
        if p.grad is None:
            p.grad = gradient
        else:
            p.grad += gradient  # a step clears what was there


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_parameters_have_rates_of_their_own(dtype: torch.dtype, tolerance: float) -> None:
    ours, theirs = _parameters(dtype), _parameters(torch.float64)
    for name, p in theirs.items():
        p.data.copy_(ours[name].detach())
    mine = Adam(ours, {"a.table": 0.02, "b": 0.005})
    groups = [{"params": [theirs["a.table"]], "lr": 0.02}, {"params": [theirs["b"]], "lr": 0.005}]
    other = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    for step, factor in enumerate((1.0, 0.5, 0.1, 0.1, 0.01)):
        _gradients(ours, step)
        for name, p in theirs.items():
            p.grad = ours[name].grad.to(torch.float64, copy=True)
        for group, rate in zip(other.param_groups, (0.02, 0.005), strict=True):
            group["lr"] = rate * factor
        other.param_groups[1]["lr"] *= 0.3
        mine.step(factor, {"b": 0.3})
        other.step()
        assert not any(p.grad.any() for p in ours.values())
    for name, p in ours.items():
        torch.testing.assert_close(p.detach().double(), theirs[name].detach(), atol=tolerance, rtol=0)


def test_a_parameter_without_a_gradient_stays() -> None:
    parameters = _parameters()
    before = parameters["b"].detach().clone()
    optimiser = Adam(parameters, dict.fromkeys(parameters, 0.1))
    parameters["a.table"].grad = torch.ones(50, 4)
    optimiser.step(1.0)
    assert torch.equal(parameters["b"], before) and parameters["b"].grad is None
    assert optimiser.count == 1


def test_cleared_gradients_change_nothing() -> None:
    parameters = _parameters()
    optimiser = Adam(parameters, dict.fromkeys(parameters, 0.1))
    parameters["a.table"].grad = torch.full((50, 4), torch.nan)
    before = {n: p.detach().clone() for n, p in parameters.items()}
    optimiser.clear()
    optimiser.step(1.0)
    assert all(torch.equal(p, before[n]) for n, p in parameters.items())
    assert not any(m.any() for moments in optimiser.moments.values() for m in moments)


def test_a_restored_optimiser_goes_on_the_same_way() -> None:
    whole, first, second = _parameters(), _parameters(), _parameters()
    rates = {"a.table": 0.02, "b": 0.005}
    a, b, c = Adam(whole, rates), Adam(first, rates), Adam(second, rates)
    for step in range(6):
        _gradients(whole, step)
        a.step(1.0)
        if step < 3:
            _gradients(first, step)
            b.step(1.0)
    for name, p in second.items():
        p.data.copy_(first[name].detach())
    c.load_state_dict(b.state_dict())
    for step in range(3, 6):
        _gradients(second, step)
        c.step(1.0)
    assert all(torch.equal(p, second[n]) for n, p in whole.items())
