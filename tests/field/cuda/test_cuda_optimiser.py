"""Adam in Triton against the definition, and the steps that it does not take."""

import pytest
import torch

from mmsynth.field.kernels import AdamStep, reference
from mmsynth.field.kernels.cuda import optimiser

COUNT = 1500  # more than a program


def _numbers(device: str) -> list[torch.Tensor]:
    """Parameter, gradient, moments."""
    parameter, gradient, first, second = torch.randn(4, COUNT)
    gradient[::3] = 0.0
    return [x.to(device) for x in (parameter, gradient, first, second.square())]


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("number", [1, 1000])
def test_adam(device: str, sparse: bool, number: int) -> None:
    found, step = _numbers(device), AdamStep(1e-2, 0.9, 0.99, 1e-15, number, sparse)
    expected = [x.double() for x in found]
    optimiser.adam(*found, step)
    reference.adam(*expected, step)
    for fast, slow in zip(found, expected, strict=True):
        torch.testing.assert_close(fast.double(), slow, atol=1e-6, rtol=1e-5)
    assert not found[1].any()


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize(("number", "beta2"), [(3, 0.95), (30, 0.999)])
def test_the_device_says_whether_and_how_far_to_step(device: str, each: bool, number: int, beta2: float) -> None:
    found, of_kinds = _numbers(device), torch.tensor([[2.0, 0.5], [0.99, beta2]], device=device).unbind()
    expected, kinds = [x.double() for x in found], (torch.arange(COUNT) % 2).to(device, torch.uint8)
    steps, rates = torch.tensor([1, number], dtype=torch.int32, device=device), torch.full((COUNT,), 1e-2, device=device)
    optimiser.guarded_adam(
        found[0], found[1], (found[2], found[3]), rates if each else rates[:1], kinds if each else 1, of_kinds, steps, 0.9, 1e-15
    )
    for kind, (factor, own) in enumerate(((2.0, 0.99), (0.5, beta2)) if each else ((0.5, beta2),) * 2):
        parts = [x[kind::2] for x in expected]
        reference.adam(*parts, AdamStep(1e-2 * factor, 0.9, own, 1e-15, number))
        for fast, slow in zip(found, parts, strict=True):
            torch.testing.assert_close(fast[kind::2].double(), slow, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("wrong", ["nothing", "loss", "gradient"])
def test_a_step_that_is_not_finite_is_not_taken(device: str, wrong: str) -> None:
    found, loss = _numbers(device), torch.tensor([1.0, 2.5], dtype=torch.float64, device=device)
    before = [x.clone() for x in found]
    if wrong == "loss":
        loss[1] = torch.nan
    if wrong == "gradient":
        found[1][1100] = torch.inf
    steps, sums = torch.tensor([0, 6], dtype=torch.int32, device=device), torch.ones(4, dtype=torch.float64, device=device)
    optimiser.check(loss, found[1], torch.tensor(40, device=device), steps, sums)
    good = wrong == "nothing"
    assert steps.tolist() == [good, 6 + good]
    assert sums.tolist() == [2.0, 2.0 - good, 41.0, 4.5 if good else 1.0]
    one = torch.ones(1, device=device)
    optimiser.guarded_adam(found[0], found[1], (found[2], found[3]), one, 0, (one, 0.99 * one), steps, 0.9, 1e-15)
    assert not found[1].any()
    assert all(torch.equal(a, b) is not good for a, b in zip((found[0], *found[2:]), (before[0], *before[2:]), strict=True))
