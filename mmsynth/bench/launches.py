"""What a step on a GPU launches, and whether the host waits in it, counted without a GPU: on CPU tensors, Triton's kernels recorded instead
of run. No value of a step decides what it launches next, so the count is that of a GPU."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from mmsynth.bench.recording import Launch, recorded_launches
from mmsynth.bench.tables import Column, Table
from mmsynth.fitting.device_step import DeviceStep
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.schedule import sampling_at, surface_beta2, surface_rates
from mmsynth.fitting.trainer import Trainer
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene

READS = {"item", "tolist", "numpy", "cpu", "__bool__", "__int__", "__float__", "__index__", "__array__"}
_WAITS = {"_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "unique_dim", "_unique2", "repeat_interleave"}
# what makes no kernel: memory, and other views of it
_NOTHING = {
    "empty",
    "empty_like",
    "empty_strided",
    "new_empty",
    "new_empty_strided",
    "detach",
    "alias",
    "_unsafe_view",
    "lift_fresh",
    "set_",
}


class Counted(NamedTuple):
    """By name: kernels of Triton; kernels of torch, one for each operation that makes one; what the host would wait for. And the former as
    they were called."""

    triton: Counter[str]
    torch: Counter[str]
    waits: Counter[str]
    calls: list[Launch]

    @property
    def launches(self) -> int:
        return self.triton.total() + self.torch.total()


class _Operations(TorchDispatchMode):
    def __init__(self, counted: Counted) -> None:
        super().__init__()
        self.counted = counted

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if name in _WAITS:
            self.counted.waits[name] += 1
        elif not func.is_view and name not in _NOTHING:
            self.counted.torch[name] += 1
        return func(*args, **(kwargs or {}))


class _Reads(TorchFunctionMode):
    def __init__(self, counted: Counted) -> None:
        super().__init__()
        self.counted = counted

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        if name in READS:
            self.counted.waits[name] += 1
        return func(*args, **(kwargs or {}))


def count(work: Callable[[], Any]) -> Counted:
    """What ``work`` launches and where it waits; its results are whatever memory held."""
    with recorded_launches() as launches:
        counted = Counted(Counter(), Counter(), Counter(), launches)
        with _Operations(counted), _Reads(counted):
            work()
    counted.triton.update(launch.name for launch in launches)
    return counted


def example_trainer() -> Trainer:
    """A fit of the example, which has five sensors, polarization among them, and may have lamps."""
    recipe = Recipe().with_changes({"radiance.light": "on"})
    return Trainer(load_scene(data_folder("example_scene")), recipe, steps=100, budget=None, seed=0, device="cpu")


def device_step(trainer: Trainer, lamps: int) -> DeviceStep:
    """The steps of a fit as its GPU would take them, of a field with so many lamps."""
    light = trainer.field.light
    if light is not None:
        light.used.zero_()
        light.add(torch.randn(lamps, 3))
    return DeviceStep(
        trainer.field, trainer.measurements, trainer.importance, trainer.optimiser, trainer.log_gain, trainer.needs, trainer.recipe,
        trainer.seed,
    )  # fmt: skip


def step_launches(step: DeviceStep, decided: bool, outside: bool = False, pairs: int = 0) -> Counted:
    """What a step launches, from the second of its stage on.

    Args:
        decided: whether exposures have factors and light comes from far away. outside: whether rays are drawn where nothing is. pairs: of
            neighbouring normals that are pulled together.
    """
    sampling = sampling_at(0.7, step.recipe, step.needs)
    stage = step.stage(sampling, 500, decided, gains=decided, early=False, pairs=pairs, outside=4)
    if outside:  # drawn from the pixels that are learned from: what is launched is the same
        step.measurements = replace(step.measurements, empty=step.measurements.chosen)
        stage = replace(stage, outside=tuple(1 for _ in stage.rays))
    of_surface, beta2 = surface_rates(sampling.sharpness, step.recipe), surface_beta2(0.7, step.needs)
    run = lambda: step.run(stage, sampling, 3, 1.0, of_surface, beta2)
    count(run)
    return count(run)


def launch_table(trainer: Trainer) -> Table:
    """Launches of a step and waits of the host, of a scene's field as a fit goes on."""
    rows = []
    for name, lamps, decided, outside in (
        ("early", 0, False, False), ("with lamps", 3, False, False), ("decided, with lamps and exposures", 3, True, False),
        ("the same, with masks of an object", 3, True, True),
    ):  # fmt: skip
        found = step_launches(device_step(trainer, lamps), decided, outside)
        rows.append({
            "stage": name, "launches": found.launches, "triton": found.triton.total(), "torch": found.torch.total(),
            "waits": found.waits.total(),
        })  # fmt: skip
    columns = (
        Column("Stage", "stage"), Column("Launches", "launches", "d"), Column("of Triton", "triton", "d"), Column("of torch", "torch", "d"),
        Column("Waits of the host", "waits", "d"),
    )  # fmt: skip
    note = (
        "Of one step, all of which but one kernel is a CUDA graph. Every 16 steps the host waits for what it was told 16 steps before, "
        "which has arrived, and the odds of tiles are renewed, without waiting; the occupancy is renewed every 32, and that waits."
    )
    return Table("Launches of a step", columns, rows, note)
