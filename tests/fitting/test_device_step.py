"""A step on the device: what it launches, and that the host waits for nothing; counted on CPU tensors, where its kernels do not run."""

import importlib.util
from typing import Any

import numpy as np
import pytest
import torch
from hopper import rows_beyond

from mmsynth.field import kernels
from mmsynth.field.kernels import reference
from mmsynth.fitting.device_step import bucket
from mmsynth.fitting.graphs import Repeated
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.smoothness import PAIRS
from mmsynth.fitting.trainer import Trainer
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene

needs_triton = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")
MOST_LAUNCHES = 40
SMALL = Recipe().with_changes({
    "surface.max_rows_log2": 10, "radiance.max_rows_log2": 10, "sampling.occupancy_resolution": 16, "radiance.light": "on",
})  # fmt: skip


@pytest.fixture(autouse=True)
def _without_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "_backend", lambda tensor: reference)


def _trainer(recipe: Recipe = SMALL) -> Trainer:
    """Of the example: five sensors, polarization among them."""
    return Trainer(load_scene(data_folder("example_scene")), recipe, steps=100, budget=None, seed=0, device="cpu")


@needs_triton
@pytest.mark.parametrize("lamps", [0, 2])
@pytest.mark.parametrize("decided", [False, True])
def test_a_step_launches_few_kernels_and_waits_for_none(lamps: int, decided: bool) -> None:
    """Also with exposures, with rays where nothing is, and with neighbours."""
    from mmsynth.bench.launches import device_step, step_launches

    step = device_step(_trainer(), lamps)
    counted = step_launches(step, decided, outside=decided, pairs=PAIRS if decided else 0)
    assert step.lamps == tuple(range(lamps)) and any(step.polarized)
    assert not counted.waits, counted.waits
    assert counted.launches <= MOST_LAUNCHES, counted[:3]
    assert counted.triton["draw"] == 1 + decided and counted.triton["compare"] == 1 and counted.triton["guarded_adam"] == 3
    assert counted.triton["mirror_backward"] == (lamps > 0) and counted.triton["gains"] == decided


@needs_triton
@pytest.mark.slow
def test_its_kernels_compile_for_hopper() -> None:
    """To machine code, without spills but for a few numbers of ``compare``, the largest."""
    from mmsynth.bench.gpu import compiled
    from mmsynth.bench.launches import device_step, step_launches

    calls = {launch.name: launch for launch in step_launches(device_step(_trainer(), 2), True, pairs=PAIRS).calls}
    of_loss = {"points", "terms", "compare", "mirror", "mirror_backward", "light_backward"}
    assert of_loss | {"draw", "aim", "check", "guarded_adam", "tally"} <= set(calls)
    for name in set(calls) - {"enter", "march", "weigh", "look", "gradient", "surface_backward", "look_backward", "weigh_backward"}:
        found, result = compiled(calls[name], 90)
        assert result.asm["cubin"] and 0 < found.registers <= 255
        assert found.spilled <= (512 if name == "compare" else 0), (name, found)
        assert not rows_beyond(result.asm["ttgir"]), name


def test_numbers_of_rays_come_in_steps() -> None:
    counts = {bucket(rays) for rays in np.geomspace(1000, 64000, 500)}
    assert len(counts) <= 26 and all(abs(bucket(rays) / rays - 1) < 0.1 for rays in (1000, 12345, 65536))


def test_work_on_the_cpu_is_repeated_as_it_is() -> None:
    done: list[Any] = []
    repeated = Repeated(lambda: done.append(1), torch.device("cpu"))
    repeated()
    repeated()
    assert len(done) == 2 and repeated.graph is None
