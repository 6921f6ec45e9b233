"""Steps of a fit as its device takes them, from photosites to moved parameters."""

import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch

sys.path += [str(Path(__file__).parents[2] / folder) for folder in ("fitting", "hard_cases")]
import test_device_step
from few_looks import few_looks
from pretended_gpu import pretended_gpu
from small_scenes import QUICK, around, write_scene

from mmsynth.field import kernels
from mmsynth.field.kernels import reference
from mmsynth.fitting.device_step import DeviceStep
from mmsynth.fitting.schedule import SurfaceRates, sampling_at
from mmsynth.fitting.trainer import Trainer
from mmsynth.scene.load import load_scene

# an operation of the interpreter takes as long for one number as for a block
FEW = {"surface.levels": 3, "radiance.levels": 3, "loss.eikonal_points": 16, "sampling.initial_rays": 8, "sampling.occupancy_resolution": 8}


def test_steps_learn_and_one_that_is_not_finite_is_not_taken(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if device != "cpu":
        pytest.skip("a fit on a GPU does it")
    monkeypatch.setattr(kernels, "_backend", lambda tensor: reference)
    trainer = test_device_step._trainer(test_device_step.SMALL.with_changes(FEW))
    field, light = trainer.field, trainer.field.light
    assert light is not None
    light.add(torch.tensor([[1.5, 2.0, -1.0], [-2.0, 0.5, 1.5]]))
    step = DeviceStep(
        field, trainer.measurements, trainer.importance, trainer.optimiser, trainer.log_gain, trainer.needs, trainer.recipe, 0
    )
    sampling = sampling_at(0.1, trainer.recipe, trainer.needs)
    stage = step.stage(sampling, 10, decided=True, gains=True, early=True, pairs=2, outside=4)
    before, table = step.flat.values.clone(), field.surface.grid.table.detach().clone()
    for number in (0, 1):  # the last layer of the surface begins with zeros: the hidden one moves with the second step
        step.run(stage, sampling, number, 1.0, SurfaceRates(0.5, 0.75), 0.875)
    news = step.news(wait=True)
    assert news is not None and (news.steps, news.bad) == (2, 0) and news.samples > 2 * sum(stage.rays) and 0.0 < news.loss < 10.0
    assert list(news.errors) == list(step.order) and all(error > 0.0 for error in news.errors.values())
    assert step.numbers.beta2.tolist() == pytest.approx([0.99, 0.875, 0.99])
    moved = step.flat.values != before
    for name, p in field.named_parameters():
        if not name.endswith("table"):
            begin = step.begins[name]
            assert p.data_ptr() == step.flat.values[begin:].data_ptr(), name
            assert bool(moved[begin : begin + p.numel()].any()), name
            assert set(step.flat.kinds[begin : begin + p.numel()].tolist()) == {int(name.startswith("surface."))}, name
    assert (field.surface.grid.table != table).any() and not step.flat.gradient.any() and not field.surface.grid.table.grad.any()
    assert 0 < int((trainer.importance.residuals != 1.0).sum()) <= 2 * sum(stage.rays)
    with torch.no_grad():
        field.shader.heads.bias.fill_(torch.nan)
    before, table = step.flat.values.clone(), field.surface.grid.table.detach().clone()
    step.run(stage, sampling, 2, 1.0, SurfaceRates(0.5, 0.75), 0.875)
    news = step.news(wait=True)
    assert news is not None and (news.steps, news.bad) == (1, 1)
    torch.testing.assert_close(step.flat.values, before, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(field.surface.grid.table, table) and not step.flat.gradient.any()
    step.sync()
    assert trainer.optimiser.count == 2


def test_a_fit_decides_all_on_its_device_and_goes_on_from_its_checkpoint(
    device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ``mmsynth fit --device cuda`` does it; on a GPU that is not there, too: what is to be a graph waits for nothing."""
    few_looks(monkeypatch, rays=8)
    monkeypatch.setattr(DeviceStep, "samples", 256)
    monkeypatch.setattr(DeviceStep, "first_rays", 8)
    scene = load_scene(write_scene(tmp_path, {"rgb": around(4), "nir": around(4)}))
    recipe = QUICK.with_changes({"radiance.exposure": "on", "radiance.light": "off", "poses.views": "on", **FEW})
    begin = lambda: Trainer(scene, recipe, steps=4, budget=None, seed=0, device="cuda")
    with pretended_gpu() if device == "cpu" else nullcontext():
        whole = begin()
        while whole.progress < 1.0:
            whole.run_step()
            if whole.state.step == 3:
                torch.save(whole.checkpoint(), tmp_path / "saved.pt")
        assert whole.on_device is not None
        later = begin()
        later.restore(torch.load(tmp_path / "saved.pt"))
        while later.progress < 1.0:
            later.run_step()
        first, second = whole.checkpoint(), later.checkpoint()
    state = whole.state
    assert state.decided is not None and state.light is not None and state.tables is not None and whole.refinement.steps > 1
    assert state.step == 4 and state.bad_steps == 0 and 0.0 < state.mean_loss < 10.0 and state.samples_total > state.rays_total
    if device == "cpu":
        assert first["state"] == second["state"]
    for name, value in first["field"].items():
        other = second["field"][name]
        if device == "cpu":
            assert torch.equal(value, other), name
        else:  # whose atomic additions have an order of their own in every run
            error = (value.double() - other.double()).abs().flatten()
            assert float(error.quantile(0.9)) <= 1e-3 * float(value.abs().max()), name


def test_arrays_that_graphs_hold_stay_or_the_graphs_go(device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where tables are as large as they should be nothing is replaced; where others take the place of moments the graphs have to go."""
    if device != "cpu":
        pytest.skip("a fit on a GPU does it")
    few_looks(monkeypatch, rays=8)
    monkeypatch.setattr(DeviceStep, "samples", 256)
    monkeypatch.setattr(DeviceStep, "first_rays", 8)
    scene = load_scene(write_scene(tmp_path, {"rgb": around(4)}))
    recipe = QUICK.with_changes({"schedule.tables_at": 0.011, **FEW})
    with pretended_gpu() as gpu:
        trainer = Trainer(scene, recipe, steps=200, budget=None, seed=0, device="cuda")
        step, table = trainer.on_device, trainer.field.surface.grid.table
        assert step is not None
        place = table.data_ptr(), trainer.optimiser.moments["surface.grid.table"][0].data_ptr()
        for _ in range(5):
            trainer.run_step()
        assert trainer.state.tables is not None and gpu.captures >= 3 and len(step.works) == 1
        assert place == (table.data_ptr(), trainer.optimiser.moments["surface.grid.table"][0].data_ptr())
        trainer.optimiser.moments["appearance.table"] = [m.clone() for m in trainer.optimiser.moments["appearance.table"]]
        (work,) = step.works.values()
        with pytest.raises(AssertionError, match="others have taken the place of"):
            trainer.run_step()
        step.renew()
        assert not step.works and work.calls > 3
        trainer.run_step()
