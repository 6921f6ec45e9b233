"""Kernels compiled or loaded before the clock starts."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import cpu
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.radiance import Shader
from mmsynth.field.rendering import trace
from mmsynth.field.surface import Surface
from mmsynth.scene.scene import Sensor


@functools.cache
def warm_up(learning: bool = True) -> None:
    """Compile the CPU kernels of a fit if they never were, and say so, and load them, so that no timed loop does it.

    Processes of their own compile, half of the kernels each: in the one that did, kernels share code that was compiled for others, and its
    sums are rounded otherwise than in every later process, which loads the kernels from the cache. Where there is no cache, this process
    has to compile.

    Args:
        learning: load those of a step, too, which a field that only renders never calls.
    """
    if not cpu.is_compiled():
        print("compiling kernels once, one to two minutes ...", file=sys.stderr, flush=True)
        _compile_apart(_HALVES)
        cpu.remove_old_kernels()
    if learning:
        run_steps()
    run_operations()


def _compile_apart(calls: Sequence[Callable[[], None]]) -> None:
    """Each in a process and with a cache of its own, whose kernels are kept when all are done."""
    with tempfile.TemporaryDirectory(prefix="mmsynth-kernels-", ignore_cleanup_errors=True) as folder:
        caches = [Path(folder) / call.__name__ for call in calls]
        children: list[subprocess.Popen[bytes]] = []
        try:
            for call, cache in zip(calls, caches, strict=True):
                program = (
                    "from mmsynth.process import set_up, with_frames_in_one_block; set_up(); "
                    f"from mmsynth.field import warmup; with_frames_in_one_block(warmup.{call.__name__})"
                )
                environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "NUMBA_CACHE_DIR": str(cache)}
                command = [sys.executable, "-c", program]
                children.append(subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
            for child in children:
                child.wait()
        finally:  # what is interrupted compiles no more
            for child in children:
                child.kill()
                child.wait()
        for cache in caches:
            cpu.keep_compiled(cache)


def _small() -> tuple[Surface, HashGrid, kernels.ShaderWeights, kernels.Measured]:
    """Of a tiny fit: surface, appearance, the shader's weights and a measured number of one ray."""
    surface, appearance = Surface(HashGrid(1, 8, 4, 4), 4, (0.5, 4.0)), HashGrid(1, 8, 4, 4)
    weights = Shader(4, 4, {"grey": Sensor("grey", ("L",), (None,))}, {"grey": 1.0}).weights()
    one, index = torch.ones(1), torch.zeros(1, dtype=torch.int64)
    return surface, appearance, weights, kernels.Measured(one, index, index, torch.empty(0, 3), one, one, one)


def run_operations() -> None:
    """Call each kernel but those of a step, with gradients."""
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        surface, appearance, weights, measured = _small()
        origins, directions = torch.tensor([[0.0, 0.0, -2.0]], requires_grad=True), torch.tensor([[0.0, 0.0, 1.0]])
        hits = trace(surface, appearance, Occupancy(4), origins, directions, torch.zeros(1), kernels.Sampling(20.0, 0.1, 1, 1))
        index = torch.zeros(1, dtype=torch.int64)
        rays = kernels.ShadedRays(hits.features, hits.share, hits.behind, directions, index, index == 0)
        loss, _ = kernels.compare(weights, rays, measured)
        lamps, share = kernels.Lamps(torch.ones(1, 3, requires_grad=True), torch.ones(1, 1)), hits.share.detach()
        mirrors = kernels.Mirrors(torch.zeros(1, 6), directions, directions, directions, share)
        loss = loss + kernels.mirror(lamps, mirrors, hits.behind, measured).sum()
        (loss + surface(origins.detach(), 1).sum()).backward()
    with torch.no_grad():
        kernels.classify(Occupancy(4).states, kernels.Cells(1.0, 1, 0, 0.1, 2.0), *surface.at(1))
        kernels.shade(weights, hits.features, directions, 0)
        kernels.reflect(lamps.position, mirrors)
        parameter, gradient, first, second = torch.zeros(4, 1)
        kernels.adam(parameter, gradient, first, second, kernels.AdamStep(1e-3, 0.9, 0.99, 1e-15, 1))
    _draw()


def run_steps() -> None:
    """Call both kernels of a step: a tiny fit."""
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        surface, appearance, weights, measured = _small()
        none, one, index = torch.empty(0), torch.ones(1), torch.zeros(1, dtype=torch.int64)
        rays = kernels.Rays(torch.tensor([[0.0, 0.0, -2.0]]), torch.tensor([[0.0, 0.0, 1.0]]), one, 3.0 * one, one - 1.0)
        step = kernels.Step(
            *surface.at(1), appearance.at(1), Occupancy(4).states, weights, kernels.no_light("cpu"), none, rays,
            kernels.View(index, index == 0), measured, kernels.Gains(none, index), kernels.Opacities(none, none, none, none, 0.05),
            kernels.Eikonal(torch.zeros(1, 3), torch.zeros(1, 3), 1.0, 0.1, 0.1, 1.0), kernels.Smooth(torch.zeros(1, 3), 1.0, 0.1),
            kernels.Sampling(20.0, 0.1, 1, 1),
        )  # fmt: skip
        kernels.learn(kernels.arrange(step))


_HALVES = (run_steps, run_operations)  # the first takes longer, nearly all of it for one kernel


def _draw() -> None:
    """A ray of the only pixel of a frame."""
    zero, one = torch.zeros(1, dtype=torch.int32), torch.ones(1, dtype=torch.int32)
    begins, single = torch.tensor([0, 1], dtype=torch.int32), torch.ones(1)
    ends, weight = kernels.odds(single, one, begins, 1.0)
    selection = kernels.Selection(ends, weight, one, torch.tensor([-1]), zero)
    stored = torch.zeros(4, dtype=torch.uint8)
    views = stored, stored.view(torch.uint16), stored.view(torch.float32)
    frames = kernels.Frames(torch.zeros(1, dtype=torch.int64), zero, one, zero, zero, torch.eye(3)[None], torch.zeros(1, 3), *views)
    cameras = kernels.Cameras(one, one, torch.zeros(1, dtype=torch.int64), one, one, torch.tensor([[0.0, 0.0, 1.0]]))
    modalities = kernels.Modalities(
        begins, begins, 8 * one, 4 * one, one, zero, -one, zero, zero, zero, single, single, single, -one, torch.empty(0, 2)
    )
    kernels.draw(frames, cameras, modalities, selection, [1], (0, 0))
