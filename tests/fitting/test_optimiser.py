"""Adam over the named parameters of a field."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from mmsynth.field import kernels
from mmsynth.fitting.optimiser import Adam, Average


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
def test_parameters_have_rates_and_epsilons_of_their_own(dtype: torch.dtype, tolerance: float) -> None:
    ours, theirs = _parameters(dtype), _parameters(torch.float64)
    for name, p in theirs.items():
        p.data.copy_(ours[name].detach())
    mine = Adam(ours, {"a.table": 0.02, "b": 0.005}, epsilons={"b": 0.5})
    groups = [{"params": [theirs["a.table"]], "lr": 0.02}, {"params": [theirs["b"]], "lr": 0.005, "eps": 0.5}]
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


def test_a_parameter_may_remember_the_size_of_gradients_for_longer() -> None:
    ours = _parameters(torch.float64)
    theirs = {name: nn.Parameter(p.detach().clone()) for name, p in ours.items()}
    mine = Adam(ours, dict.fromkeys(ours, 0.02))
    groups = [{"params": [theirs["a.table"]], "betas": (0.9, 0.99)}, {"params": [theirs["b"]], "betas": (0.9, 0.999)}]
    other = torch.optim.Adam(groups, lr=0.02, eps=1e-15)
    for step in range(5):
        _gradients(ours, step)
        for name, p in theirs.items():
            p.grad = ours[name].grad.clone()
        for part in mine.parts(1.0, beta2={"b": 0.999}):
            kernels.adam(*part)
        mine.count += 1
        other.step()
    for name, p in ours.items():
        torch.testing.assert_close(p.detach(), theirs[name].detach(), atol=1e-14, rtol=0)


def test_a_parameter_without_a_gradient_stays() -> None:
    parameters = _parameters()
    before = parameters["b"].detach().clone()
    optimiser = Adam(parameters, dict.fromkeys(parameters, 0.1))
    parameters["a.table"].grad = torch.ones(50, 4)
    optimiser.step(1.0)
    assert torch.equal(parameters["b"], before) and not any(m.any() for m in optimiser.moments["b"])
    assert optimiser.count == 1


@pytest.mark.parametrize("size", [30, 50, 80])
def test_an_optimiser_and_a_mean_follow_a_table_of_another_size(size: int) -> None:
    parameters = _parameters()
    optimiser, average = Adam(parameters, dict.fromkeys(parameters, 0.1)), Average(parameters)
    _gradients(parameters, 0)
    optimiser.step(1.0)
    average.update(4.0)
    moments, mean, table = [m.clone() for m in optimiser.moments["a.table"]], average.means["a.table"].clone(), parameters["a.table"]
    table.data, table.grad = torch.cat([table.data[:20], torch.ones(size - 20, 4)]), None
    optimiser.resize("a.table", 20)
    average.resize("a.table", 20)
    for new, old in zip(optimiser.moments["a.table"], moments, strict=True):
        assert torch.equal(new[:20], old[:20]) and new.shape == (size, 4) and not new[20:].any()
    assert torch.equal(average.means["a.table"][:20], mean[:20]) and (average.means["a.table"][20:] == 1).all()
    parameters["b"].grad, table.grad = None, torch.ones(size, 4)
    optimiser.step(1.0)
    average.update(4.0)
    assert table.shape == average.means["a.table"].shape == (size, 4)


def test_moments_of_a_table_that_keeps_its_size_stay_where_they_are() -> None:
    """A GPU's graphs go on with them."""
    optimiser = Adam(parameters := _parameters(), dict.fromkeys(parameters, 0.1))
    before = list(optimiser.moments["a.table"])
    optimiser.resize("a.table", len(parameters["a.table"]))
    assert all(new is old for new, old in zip(optimiser.moments["a.table"], before, strict=True))


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


def _moving(average: Average, parameters: dict[str, nn.Parameter], count: int, length: float) -> list[torch.Tensor]:
    """Values of "b" that were taken in."""
    taken = []
    for step in range(count):
        torch.manual_seed(step)
        for p in parameters.values():
            p.data.copy_(torch.randn(p.shape))
        taken.append(parameters["b"].detach().clone())
        average.update(length)
    return taken


def test_the_mean_of_few_values_is_their_plain_mean() -> None:
    parameters = _parameters()
    average = Average(parameters)
    taken = _moving(average, parameters, 9, length=20.0)
    average.apply()
    torch.testing.assert_close(parameters["b"].detach(), torch.stack(taken).mean(0))


def test_the_mean_of_many_values_forgets_as_torchs_does() -> None:
    ours, model = _parameters(), nn.Linear(1, 1)
    average = Average(ours)
    theirs = torch.optim.swa_utils.AveragedModel(model, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(1 - 1 / 5.0))
    taken = _moving(average, ours, 60, length=5.0)
    for value in taken:
        model.bias.data.copy_(value[:1])
        theirs.update_parameters(model)
    # they begin otherwise; 60 values later 0.8 to the power of 60 is left of that
    torch.testing.assert_close(average.means["b"][:1], theirs.module.bias.detach(), atol=1e-5, rtol=0)


def test_without_a_value_nothing_is_applied_and_a_saved_mean_goes_on() -> None:
    parameters = _parameters()
    before = parameters["b"].detach().clone()
    average = Average(parameters)
    average.apply()
    assert torch.equal(parameters["b"], before)
    _moving(average, parameters, 4, length=3.0)
    again = Average(parameters)
    again.load_state_dict({"count": average.count, "means": {n: m.clone() for n, m in average.means.items()}})
    for one in (average, again):
        _moving(one, parameters, 3, length=3.0)
    assert torch.equal(average.means["a.table"], again.means["a.table"])
