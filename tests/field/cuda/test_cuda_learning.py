"""A whole step in Triton: the cases of the CPU's, against the definition in float64."""

import pytest
import test_learning
import torch

from mmsynth.field import kernels
from mmsynth.field.kernels import cuda


@pytest.mark.parametrize("case", ["background", "far light", "all"])
def test_a_step_is_that_of_the_definition(device: str, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if device == "cuda":
        torch.set_default_device(device)
    monkeypatch.setattr(kernels, "learn", lambda arranged: cuda.learn(arranged.step))
    monkeypatch.setattr(test_learning, "RAYS", 36)
    test_learning.test_a_step_is_that_of_the_definition(case)
