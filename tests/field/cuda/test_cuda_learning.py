"""A whole step in Triton: the cases of the CPU's, against the definition in float64."""

import pytest
import test_learning
import torch
from on_device import make_on_cpu

from mmsynth.field import kernels
from mmsynth.field.kernels import cuda


@pytest.mark.parametrize("case", ["background", "far light", "all"])
def test_a_step_is_that_of_the_definition(device: str, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make_on_cpu(test_learning, "_step", device, monkeypatch)
    monkeypatch.setattr(kernels, "learn", lambda arranged: cuda.learn(arranged.step))
    monkeypatch.setattr(test_learning, "RAYS", 36)
    with torch.device(device):
        test_learning.test_a_step_is_that_of_the_definition(case)
