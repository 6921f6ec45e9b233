"""A GPU that is not there (``pretended_gpu``): nothing that is fitted or made on it may touch two devices at once, or be another field."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from few_looks import few_looks
from pretended_gpu import pretended_gpu

sys.path.append(str(Path(__file__).parents[1] / "hard_cases"))
from small_scenes import QUICK, around, write_scene
from test_device_step import SMALL

from mmsynth.field import kernels
from mmsynth.field.kernels import reference
from mmsynth.field.storage import load_field
from mmsynth.fitting import device_step
from mmsynth.fitting import trainer as trainer_module
from mmsynth.fitting.checkpoint import read_checkpoint
from mmsynth.fitting.graphs import Repeated
from mmsynth.fitting.run import fit
from mmsynth.operations.conversion.files import convert_files
from mmsynth.operations.dataset.generate import generate_dataset
from mmsynth.operations.evaluation.evaluate import evaluate
from mmsynth.operations.mesh.extract import MeshOptions, extract_mesh
from mmsynth.operations.simulation.simulate import simulate
from mmsynth.operations.views.displays import find_display, look
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import PosedCamera


@pytest.mark.parametrize(
    "mix",
    [
        lambda there, here: there + here,
        lambda there, here: torch.cat([there, here]),
        lambda there, here: torch.where(there > 0, here, 0.0),
        lambda there, here: here[there.long()],
        lambda there, here: there.index_add(0, here.long(), there),
        lambda there, here: torch.stack([there, here.sum().expand(3)]),
        lambda there, here: here + there.sum(),
        lambda there, here: there.copy_(here).mul_(here),
        lambda there, here: torch.nn.functional.linear(here, there),
        lambda there, here: torch.rand(3, device="cuda", generator=torch.Generator()),
        lambda there, here: there.view(3, 1) @ here.view(1, 3),
        lambda there, here: torch.zeros_like(there) + here,
        lambda there, here: here.new_zeros(3) + there.new_zeros(3),
    ],
)
def test_what_torch_refuses_on_two_devices_is_refused(mix: Callable[[torch.Tensor, torch.Tensor], object]) -> None:
    with pretended_gpu():
        there, here = torch.ones(3, device="cuda"), torch.ones(3)
        with pytest.raises(RuntimeError):
            mix(there, here)


@pytest.mark.parametrize(
    "waits",
    [
        lambda there: there.sum().item(),
        lambda there: bool(there[0]),
        lambda there: there.nonzero(),
        lambda there: there.cpu(),
        lambda there: there.copy_(torch.ones(3)),
        lambda there: torch.tensor([1.0], device=there.device),
        lambda there: there.new_tensor([1.0]),
        lambda there: torch.ones(3).to(there.device),
    ],
)
def test_a_graph_waits_for_nothing(waits: Callable[[torch.Tensor], object]) -> None:
    """A stage's first step may, what is captured from the second on may not."""
    with pretended_gpu() as gpu:
        there = torch.ones(3, device="cuda")
        work = Repeated(lambda: waits(there), there.device)
        work()
        with pytest.raises(RuntimeError, match="not permitted when stream is capturing"):
            work()
        launches = Repeated(lambda: there.add_(torch.ones_like(there)), there.device)
        launches()
        launches()
        assert gpu.captures == 2 and not gpu.captured


def test_what_torch_allows_on_two_devices_goes_on() -> None:
    with pretended_gpu():
        there, here = torch.ones(3, device="cuda", requires_grad=True), torch.ones(3)
        loss = (there * 2.0 + here.sum())[torch.tensor([0, 2])] @ here[:2].to(there)
        assert loss.device.type == "cuda" and loss.is_cuda and loss.cpu().device.type == "cpu"
        loss.backward()
        gradient = there.grad
        assert gradient is not None and gradient.device == there.device and gradient.tolist() == [2.0, 0.0, 2.0]
        codes = torch.ones(3, dtype=torch.uint16, device="cuda")
        with pytest.raises(NotImplementedError):
            codes[torch.tensor([0, 1])]
        assert codes[1:].float().tolist() == [1.0, 1.0]
        for read in (lambda: there.detach().numpy(), lambda: np.asarray(there.detach())):
            with pytest.raises(TypeError):
                read()
        copy = there.detach().cpu()
        copy[0] = 5.0
        assert there.tolist() == [1.0, 1.0, 1.0] and copy.numpy()[0] == 5.0 and there.detach().numpy(force=True)[0] == 1.0
        layer = torch.nn.Linear(3, 1).to("cuda")
        assert all(p.device.type == "cuda" for p in layer.parameters()) and layer(there).is_cuda
    assert torch.ones(3).device.type == "cpu"


def _on_both(work: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any]:
    """What it gives on the CPU and on a GPU without Triton, both by torch's operations, of one thread: two add in any order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        monkeypatch.setattr(kernels, "_on_gpu", lambda: reference)
        with pretended_gpu():
            on_gpu = work("cuda")
        monkeypatch.setattr(kernels, "_backend", lambda tensor: reference)
        return work("cpu"), on_gpu
    finally:
        torch.set_num_threads(threads)


def test_a_fit_without_triton_is_that_of_the_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the example, which has five sensors: lamps, exposures, directions, motions and rows are decided; interrupted and gone on with."""
    few_looks(monkeypatch)
    scene = load_scene(data_folder("example_scene"))
    recipe = SMALL.with_changes({"radiance.exposure": "on", "poses.views": "on", "sampling.initial_rays": 64})

    def work(device: str) -> dict[str, Any]:
        fit(scene, tmp_path / device, recipe=recipe, steps=3, device=device)
        saved = read_checkpoint(tmp_path / device)
        assert saved is not None
        return saved

    on_cpu, on_gpu = _on_both(work, monkeypatch)
    assert on_gpu["state"]["step"] == 3 and on_gpu["state"]["decided"] is not None and on_gpu["state"]["light"] is not None
    assert on_gpu["refinement"]["steps"] > 0
    _same(on_gpu, on_cpu)


def test_between_decisions_the_host_waits_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not in 40 steps of a fit on a GPU between two looks for lamps, in which it selects rays anew and hears of its steps; kernels are left
    out."""

    def work(step: device_step.DeviceStep, *_: object) -> Callable[[], object]:
        one = torch.tensor([1.0, 0.0, *[1.0] * (len(step.told) - 2)], dtype=step.told.dtype, device=step.told.device)  # none is bad
        return lambda: step.told.add_(one)

    monkeypatch.setattr(kernels, "_on_gpu", lambda: reference)
    monkeypatch.setattr(kernels, "fused_on_gpu", lambda: True)
    monkeypatch.setattr(device_step.DeviceStep, "_work", work)
    monkeypatch.setattr(device_step.stepping, "set_numbers", lambda *_: None)
    looks = lambda field, *_: field.light.add(torch.ones(1, 3, device=field.device))
    monkeypatch.setattr(trainer_module, "look_for_lamps", looks)
    few_looks(monkeypatch)
    recipe = SMALL.with_changes({
        "sampling.occupancy_every": 1000, "schedule.light_at": 0.3, "schedule.light_until": 0.45, "schedule.decide_at": 0.6,
        "poses.start_at": 0.9,
    })  # fmt: skip
    with pretended_gpu() as gpu:
        trainer = trainer_module.Trainer(load_scene(data_folder("example_scene")), recipe, steps=1000, budget=None, seed=0, device="cuda")
        trainer.state.step = 305
        trainer.run_step()
        assert gpu.waits and trainer.state.light_looks == 1 and trainer.state.light is None and trainer.on_device is not None
        gpu.waits.clear()
        rays = trainer.state.rays
        for _ in range(40):
            trainer.run_step()
        assert not gpu.waits and trainer.state.light_looks == 1
        assert trainer.state.mean_loss == 1.0 and trainer.state.rays > 1.4 * rays  # it heard of steps, and that they have too few samples
        assert trainer.on_device.lamps == (0,)


def _numbers(found: Any) -> Iterator[np.ndarray]:
    """All that is in it, but for the time that it took."""
    if isinstance(found, torch.Tensor | np.ndarray | float | int):
        yield np.asarray(found, float).ravel()
    elif isinstance(found, dict):
        for name, value in found.items():
            yield from () if name == "elapsed" else _numbers(value)
    elif isinstance(found, list | tuple):
        for value in found:
            yield from _numbers(value)


def _same(found: Any, expected: Any) -> None:
    """But for the last bits: sums depend on where an array begins, and Adam takes a step of one size by a gradient of any."""
    a, b = (np.concatenate(list(_numbers(x))) for x in (found, expected))
    assert len(a) == len(b) > 100 and np.array_equal(np.isfinite(a), np.isfinite(b))
    assert np.mean(np.isclose(a, b, rtol=1e-3, atol=1e-6, equal_nan=True)) > 0.999


def test_what_is_made_on_a_gpu_is_what_the_cpu_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few_looks(monkeypatch)
    scene = load_scene(write_scene(tmp_path / "scene", {"rgb": around(3), "nir": around(3)}))
    views = [PosedCamera(f.camera, f.camera_to_world, "view") for f in scene.frames_of("rgb", scene.split.test)]

    def work(device: str) -> dict[str, Any]:
        field = fit(scene, tmp_path / device, recipe=QUICK, steps=3, device=device)
        scores = evaluate(field, scene)
        again = load_field(tmp_path / device, device=device)
        generate_dataset(again, views, tmp_path / device / "dataset", scene=scene)
        mesh = extract_mesh(again, MeshOptions(resolution=12), scene=scene)
        convert_files(again, scene, tmp_path / device / "converted", source="rgb", target="nir", frames=[1])
        made = {}
        for path in sorted((tmp_path / device).rglob("*.npz")):
            with np.load(path) as file:
                made |= {
                    f"{path.relative_to(tmp_path / device)}/{name}": file[name] for name in file.files if file[name].dtype.kind in "fiu"
                }
        shown = look(again, views[0], [find_display(again, name) for name in ("rgb", "normals", "nir")])
        simulate(again, ["mmsdata_infrared"], tmp_path / device / "frames", frames="test", scene=scene)
        frames = {path.name: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((tmp_path / device / "frames").rglob("*.png"))}
        return {
            "scores": scores["modalities"], "files": made, "vertices": mesh.vertices.copy(), "colours": mesh.visual.vertex_colors.copy(),
            "shown": shown, "frames": frames,
        }  # fmt: skip

    on_cpu, on_gpu = _on_both(work, monkeypatch)
    assert 0.0 < on_gpu["scores"]["rgb"]["psnr"] < 60.0 and len(on_gpu["vertices"]) > 50 and len(on_gpu["files"]) > 8
    assert on_gpu["frames"] and any("converted" in name for name in on_gpu["files"])
    _same(on_gpu, on_cpu)
