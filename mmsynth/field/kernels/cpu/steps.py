"""A step of a fit: two kernels, and what Python does beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from mmsynth.field.kernels.constants import FEATURES
from mmsynth.field.kernels.cpu import learning, slopes
from mmsynth.field.kernels.cpu.arrays import as_arrays, as_compiled, in_double, shader_layers
from mmsynth.field.kernels.cpu.blocks import surface_layers
from mmsynth.field.kernels.cpu.drawing import ToFill, nothing_to_draw, room_for
from mmsynth.field.kernels.cpu.learning import WeightGradients
from mmsynth.field.kernels.cpu.marching import CHUNK
from mmsynth.field.kernels.cpu.mirrors import lamps_and_layers
from mmsynth.field.kernels.cpu.optimiser import places_and_numbers
from mmsynth.field.kernels.cpu.stores import chunk_scratch, light_out, ray_store, shading_store, table_store, tap_store
from mmsynth.field.kernels.cpu.tasks import take_beside
from mmsynth.field.kernels.learning import gradient_of, no_light
from mmsynth.field.kernels.parameters import AdamPart, Arranged, Drawing, Drawn, Learned, Step
from mmsynth.threads import kernel_threads


class _Made(NamedTuple):
    """Of ``Arranged``: the step with arrays in the place of tensors, and what is drawn beside it."""

    step: Any
    ahead: tuple[tuple[ToFill, Drawn], ...]


@torch.no_grad()
def arrange(step: Step, ahead: Sequence[Drawing] = ()) -> Arranged:
    """See ``kernels.arrange``."""
    arrays: list[Any] = [as_arrays(x) if isinstance(x, tuple) else as_compiled(x) for x in step]
    of_step = Step(*arrays)._replace(sampling=in_double(step.sampling))
    return Arranged(step, tuple(ahead), _Made(of_step, tuple(room_for(drawing) for drawing in ahead)))


@torch.no_grad()
def learn(
    arranged: Arranged,
    update: Callable[[], Sequence[AdamPart]] | None = None,
    meanwhile: Callable[[Learned], None] | None = None,
) -> Learned:
    """See ``kernels.learn`` and ``learning.learn``; float32, ``measured.ray`` never decreasing."""
    step, (made, ahead) = arranged.step, arranged.made
    table, network, look, states, shader, light, far_light, rays, view, measured, gains, opacities, eikonal, smooth, sampling, roulette = (
        made
    )
    count, numbers, points = len(rays.origins), len(measured.target), len(eikonal.points)
    chunks, threads = -(-count // CHUNK), kernel_threads()
    tasks = chunks + -(-points // slopes.POINTS)
    units, levels = len(network.hidden), len(table.resolutions)
    features, hidden, used = FEATURES * len(look.resolutions), len(light.first), light.used
    columns, lamps, shining = lamps_and_layers(light)
    gain = np.empty(0, np.float32)
    if len(gains.log_gain):
        of_frames = np.exp(gains.log_gain - np.mean(gains.log_gain, dtype=np.float64)).astype(np.float32)
        gain = of_frames[gains.frame]
    store, taps = ray_store(threads, units, levels, len(look.resolutions)), tap_store(tasks, units, levels)
    kept = table_store(chunks, units, levels, len(look.resolutions))
    weights = shading_store(max(chunks, threads), shader)
    scratch = chunk_scratch(threads, units, features, len(columns), hidden)
    out = light_out(tasks, features, len(columns), hidden, len(used), len(shader.heads_bias))
    squared, mirrored = np.empty(numbers, np.float32), np.empty(numbers if len(used) else 0, np.float32)
    g_mirrored, g_gain, samples = np.empty_like(mirrored), np.empty_like(gain), np.zeros(max(chunks, 1), np.int64)
    first, second = (*(to_fill for to_fill, _ in ahead), nothing_to_draw(), nothing_to_draw())[:2]
    to_learn = (
        np.zeros(2, np.int64), rays, states, sampling, table, surface_layers(network), look, *shader_layers(shader), shining, lamps,
        far_light, view, measured, gain, opacities, eikonal, smooth, roulette, first, second, store.arrays, kept.arrays, taps.arrays,
        weights.arrays, scratch.arrays, out.arrays, samples, squared, mirrored, g_mirrored, g_gain,
    )  # fmt: skip
    sums, done = np.zeros(2), np.zeros(1 + table.active + look.active, np.int64)

    def to_finish() -> tuple[Any, ...]:
        learned = (*step.network[:2], *step.shader, *(step.light[:6] if len(used) else no_light("cpu")[:6]), step.far_light)
        gradients = WeightGradients(*(gradient_of(x).numpy() for x in learned))
        of_levels: dict[int, tuple[Any, int]] = {
            step.grid.table.data_ptr(): (table.offsets[: table.active + 1], 1),
            step.appearance.table.data_ptr(): (look.offsets[: look.active + 1], 1 + table.active),
        }
        return (
            np.zeros(1, np.int64), done, count, points, table, network, look, kept.arrays, taps.arrays, weights.arrays, out.arrays, columns,
            used, lamps.spectrum, gradient_of(step.grid.table).numpy(), gradient_of(step.appearance.table).numpy(), gradients, sums,
            *places_and_numbers(update() if update is not None else (), of_levels),
        )  # fmt: skip

    finish = take_beside(to_finish, threads, learning.learn_rays, to_learn)
    loss = sums[0] = out.arrays.loss[:tasks].sum()
    if len(gain):
        by_frame = np.bincount(gains.frame, g_gain, len(of_frames)) * of_frames
        of_gains = by_frame - by_frame.mean()
        gradient_of(step.gains.log_gain).numpy()[...] += of_gains.astype(np.float32)
        sums[1] = of_gains.sum()

    def to_tell() -> Learned:
        found = (torch.from_numpy(np.array(x, kind)) for x, kind in ((loss, np.float32), (samples.sum(), np.int64)))
        result = Learned(next(found), torch.from_numpy(sums)[1], torch.from_numpy(squared), next(found), tuple(drawn for _, drawn in ahead))
        if meanwhile is not None:
            meanwhile(result)
        return result

    return take_beside(to_tell, threads, learning.finish, finish)
