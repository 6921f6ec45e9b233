"""A fit's own clock holds no compilation."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

from mmsynth.errors import Interrupted
from mmsynth.field import warmup
from mmsynth.field.kernels import cpu
from mmsynth.field.kernels.cpu import (
    blocks,
    drawing,
    learning,
    marching,
    matrices,
    mirroring,
    optimiser,
    shading,
    surface,
    tracing_gradients,
)
from mmsynth.field.warmup import warm_up
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import fit
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene


def _signatures() -> dict[str, list[object]]:
    modules = (blocks, drawing, learning, marching, matrices, mirroring, optimiser, shading, surface, tracing_gradients)
    return {f"{m.__name__}.{n}": list(x.signatures) for m in modules for n, x in vars(m).items() if isinstance(x, Dispatcher)}


@pytest.mark.usefixtures("decided_by_few_rays")
def test_a_fit_compiles_nothing_after_it_began(tmp_path: Path) -> None:
    """Nor loads from the cache: pose evidence, the probe, sized tables, exposure and rendering with normals meet what was warmed up."""
    warm_up()
    before = _signatures()
    assert all(len(k.signatures) == 1 for k in cpu.KERNELS)
    field = fit(load_scene(data_folder("example_scene")), tmp_path / "run", recipe=Recipe(), steps=40)
    assert field.manifest["steps"] == 40
    frame = load_scene(data_folder("example_scene")).frames[0]
    field.render(frame.camera, frame.camera_to_world)
    assert _signatures() == before


class _Child:
    """In the place of a process: what was started, waited for and killed."""

    def __init__(self, log: list[str], command: list[str], wait: Callable[[], None]) -> None:
        self.log, self.what, self._wait = log, command[-1].split("warmup.")[-1].rstrip(")"), wait
        assert command[0] == sys.executable
        log.append(f"start {self.what}")

    def wait(self) -> None:
        self.log.append(f"wait {self.what}")
        self._wait()

    def kill(self) -> None:
        self.log.append(f"kill {self.what}")


def test_other_processes_compile_and_this_one_loads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a first fit would round otherwise than all later ones."""
    log, caches = list[str](), set[str]()
    with monkeypatch.context() as patch:
        patch.setattr(cpu, "is_compiled", lambda: False)
        patch.setattr(cpu, "remove_old_kernels", lambda: None)  # the user's own
        patch.setattr(
            warmup.subprocess, "Popen", lambda command, env, **_: caches.add(env["NUMBA_CACHE_DIR"]) or _Child(log, command, lambda: None)
        )
        warmup.warm_up.__wrapped__()
    steps, operations = "run_steps", "run_operations"
    apart = [f"start {steps}", f"start {operations}", f"wait {steps}", f"wait {operations}"]
    assert log[:4] == apart and {f"kill {steps}", f"kill {operations}"} <= set(log[4:]) and len(caches) == 2
    program = (
        "from mmsynth.field.warmup import warm_up\n"
        "from mmsynth.field.kernels import cpu\n"
        "warm_up(learning=False)\n"
        "print([k.__name__ for k in cpu.KERNELS if not k.stats.cache_hits])\n"
        "warm_up()\n"
        "print([(len(k.stats.cache_hits), len(k.stats.cache_misses)) for k in cpu.KERNELS])"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    of_steps = ["learn_rays", "finish", "lamps_and_layers"]
    assert run.stdout == f"{of_steps}\n{[(1, 0)] * len(cpu.KERNELS)}\n", run.stderr


def test_what_is_interrupted_compiles_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[str] = []

    def interrupted() -> None:
        if log.count("wait run_steps") == 1:
            raise Interrupted("stop")

    monkeypatch.setattr(cpu, "is_compiled", lambda: False)
    monkeypatch.setattr(warmup.subprocess, "Popen", lambda command, **_: _Child(log, command, interrupted))
    with pytest.raises(Interrupted):
        warmup.warm_up.__wrapped__()
    assert "kill run_steps" in log and log[-2:] == ["kill run_operations", "wait run_operations"]
