"""Steps of a fit as its device takes them, from photosites to moved parameters."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).parents[2] / "fitting"))
import test_device_step

from mmsynth.field import kernels
from mmsynth.field.kernels import reference
from mmsynth.fitting.device_step import DeviceStep
from mmsynth.fitting.schedule import sampling_at


def test_steps_learn_and_one_that_is_not_finite_is_not_taken(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if device != "cpu":
        pytest.skip("a fit on a GPU does it")
    monkeypatch.setattr(kernels, "_backend", lambda tensor: reference)
    trainer = test_device_step._trainer()
    field, light = trainer.field, trainer.field.light
    assert light is not None
    light.add(torch.tensor([[1.5, 2.0, -1.0], [-2.0, 0.5, 1.5]]))
    step = DeviceStep(
        field, trainer.measurements, trainer.importance, trainer.optimiser, trainer.log_gain, trainer.needs, trainer.recipe, 0
    )
    sampling = sampling_at(0.1, trainer.recipe, trainer.needs)
    stage = step.stage(sampling, 20, decided=True, gains=True, early=True, outside=4)
    before, table = step.flat.values.clone(), field.surface.grid.table.detach().clone()
    for number in (0, 1):  # the last layer of the surface begins with zeros: the hidden one moves with the second step
        step.run(stage, sampling, number, 1.0, 0.5)
    news = step.news(wait=True)
    assert news is not None and (news.steps, news.bad) == (2, 0) and news.samples > 2 * sum(stage.rays) and 0.0 < news.loss < 10.0
    assert list(news.errors) == list(step.order) and all(error > 0.0 for error in news.errors.values())
    moved = step.flat.values != before
    for name, p in field.named_parameters():
        if not name.endswith("table"):
            begin = step.begins[name]
            assert p.data_ptr() == step.flat.values[begin:].data_ptr(), name
            assert bool(moved[begin : begin + p.numel()].any()), name
    assert (field.surface.grid.table != table).any() and not step.flat.gradient.any() and not field.surface.grid.table.grad.any()
    assert 0 < int((trainer.importance.residuals != 1.0).sum()) <= 2 * sum(stage.rays)
    with torch.no_grad():
        field.shader.heads.bias.fill_(torch.nan)
    before, table = step.flat.values.clone(), field.surface.grid.table.detach().clone()
    step.run(stage, sampling, 2, 1.0, 0.5)
    news = step.news(wait=True)
    assert news is not None and (news.steps, news.bad) == (1, 1)
    torch.testing.assert_close(step.flat.values, before, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(field.surface.grid.table, table) and not step.flat.gradient.any()
    step.sync()
    assert trainer.optimiser.count == 2
