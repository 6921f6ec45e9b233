"""A fit's own clock holds no compilation."""

import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

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


def test_another_process_compiles_and_this_one_loads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else a first fit would round otherwise than all later ones."""
    started: list[list[str]] = []
    with monkeypatch.context() as patch:
        patch.setattr(cpu, "is_compiled", lambda: False)
        patch.setattr(warmup.subprocess, "run", lambda command, **_: started.append(command))
        warmup.warm_up.__wrapped__()
    assert [command[0] for command in started] == [sys.executable] and "run_kernels()" in started[0][-1]
    program = (
        "from mmsynth.field.warmup import warm_up; warm_up()\n"
        "from mmsynth.field.kernels import cpu\n"
        "print([(len(k.stats.cache_hits), len(k.stats.cache_misses)) for k in cpu.KERNELS])"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert run.stdout == f"{[(1, 0)] * len(cpu.KERNELS)}\n", run.stderr
