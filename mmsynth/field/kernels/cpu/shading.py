"""Shading on the CPU, fused: from the features of rays to the loss of what was measured along them, and all its gradients, in one pass.

Work is cut into chunks of ``CHUNK`` rays; what they meet passes the layers of the shader as matrices with a row per surface. A ray
needs few of the shader's outputs (a pixel under a mosaic one, a polarization six), and only those are computed. Gradients of weights
are summed per task of ``TOGETHER`` chunks, and the tasks in order, whatever the number of threads.

Matrices have whole tiles, see ``matrices``: they are padded with zeros.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types

from mmsynth.field.kernels.constants import HUBER_DELTA
from mmsynth.field.kernels.cpu.jit import allocating_kernel, allocating_part, inlined, kernel, part
from mmsynth.field.kernels.cpu.logistic import softplus_of
from mmsynth.field.kernels.cpu.matrices import TILE_COLS, TILE_ROWS, add_product, clear, padded, whole
from mmsynth.field.kernels.cpu.stack import on_stack
from mmsynth.field.kernels.cpu.tasks import take

CHUNK = 64  # rays
TOGETHER = 8  # chunks of a task of ``compare``: 40 KB of gradients for each chunk would be a third of its time
_HUBER = np.float32(HUBER_DELTA)
_of_surfaces, _places_of_surfaces = on_stack(types.float32, 2 * CHUNK), on_stack(types.int64, 2 * CHUNK)
_outputs, _slopes_of_both = on_stack(types.float32, 6), on_stack(types.float32, 12)  # of a polarization
_lights_of_both, _places_of_both = on_stack(types.float32, 2), on_stack(types.int64, 2)
_FAST = {"contract", "reassoc", "nsz", "arcp"}  # but NaN stays NaN: a loss that is not finite must be seen


@part()
def _harmonics(x, y, z, degree, out):  # type: ignore[no-untyped-def]
    """Real spherical harmonics (see ``reference.spherical_harmonics``); terms above the degree are left as they are."""
    f = np.float32
    out[0] = f(0.28209479177387814)
    if degree < 1:
        return
    out[1] = f(0.4886025119029199) * y
    out[2] = f(0.4886025119029199) * z
    out[3] = f(0.4886025119029199) * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    out[4] = f(1.0925484305920792) * x * y
    out[5] = f(1.0925484305920792) * y * z
    out[6] = f(0.31539156525252005) * (f(3.0) * zz - f(1.0))
    out[7] = f(1.0925484305920792) * x * z
    out[8] = f(0.5462742152960396) * (xx - yy)
    if degree < 3:
        return
    out[9] = f(0.5900435899266435) * y * (f(3.0) * xx - yy)
    out[10] = f(2.890611442640554) * x * y * z
    out[11] = f(0.4570457994644658) * y * (f(5.0) * zz - f(1.0))
    out[12] = f(0.3731763325901154) * z * (f(5.0) * zz - f(3.0))
    out[13] = f(0.4570457994644658) * x * (f(5.0) * zz - f(1.0))
    out[14] = f(1.445305721320277) * z * (xx - yy)
    out[15] = f(0.5900435899266435) * x * (xx - f(3.0) * yy)


@part(fastmath=_FAST)
def layer(n, x, inputs, weight, bias, out):  # type: ignore[no-untyped-def]
    """out = rectified (x @ weight + bias), of n rays. weight: (inputs, units)."""
    rows, units = whole(n, TILE_ROWS), out.shape[1]
    clear(out, rows, units)
    for i in range(n):
        for k in range(len(bias)):
            out[i, k] = bias[k]
    add_product(x, weight, out, rows, inputs, units)
    for i in range(n):
        for k in range(units):
            v = out[i, k]
            out[i, k] = np.float32(0.0) if v <= np.float32(0.0) else v


@part(fastmath=_FAST)
def layer_backward(n, x, inputs, g, out, weight_out, bias_out):  # type: ignore[no-untyped-def]
    """Gradients of a layer's weights (units, inputs); g: those of what came out, then those before the rectification."""
    units = g.shape[1]
    for i in range(n):
        for k in range(units):
            g[i, k] = g[i, k] if out[i, k] > np.float32(0.0) else np.float32(0.0)
            bias_out[k] += g[i, k]
    add_product(g.T, x, weight_out, units, n, inputs)


@part()
def _intensity(raw, e, slope):  # type: ignore[no-untyped-def]
    """|Lᵀ e|² (see ``shading.intensity`` of the definition) and its slope, both of six numbers."""
    two = np.float32(2.0)
    a, slope_a = softplus_of(raw[0])
    b, slope_b = softplus_of(raw[1])
    c, slope_c = softplus_of(raw[2])
    v0 = a * e[0] + raw[3] * e[1] + raw[4] * e[2]
    v1 = b * e[1] + raw[5] * e[2]
    v2 = c * e[2]
    slope[0], slope[1], slope[2] = two * v0 * e[0] * slope_a, two * v1 * e[1] * slope_b, two * v2 * e[2] * slope_c
    slope[3], slope[4], slope[5] = two * v0 * e[1], two * v0 * e[2], two * v1 * e[2]
    return v0 * v0 + v1 * v1 + v2 * v2


@part(fastmath=_FAST)
def _measurements(  # type: ignore[no-untyped-def]
    ray0, span, place_of, share, hidden, trains, measured, gain, mirrored, heads, heads_bias, learn, squared, g_hidden, g_share, g_gain,
    g_mirrored, heads_out, heads_bias_out,
):  # fmt: skip
    """What was measured along the rays of a chunk, of which ``ray0`` is the first: the loss. Gradients are added to.

    span: of the measurements, the first and where they end. hidden: (n, H), share, g_share (n,): a row per surface, those nearest first;
    place_of: of each ray, the row of what is behind that, -1 = nothing. trains: of each ray.
    """
    target, ray, output, axes, level = measured.target, measured.ray, measured.output, measured.axes, measured.level
    raw, slope, lights, places = _outputs(), _slopes_of_both(), _lights_of_both(), _places_of_both()
    bright = len(ray) - len(axes)
    units = heads.shape[1]
    loss = 0.0
    for m in range(span[0], span[1]):
        o, column = ray[m] - ray0, output[m]
        places[0], places[1] = o, place_of[o]
        surfaces = 2 if place_of[o] >= 0 else 1
        outputs = 1 if m < bright else 6
        seen = mirrored[m] if len(mirrored) else np.float32(0.0)
        for a in range(surfaces):
            h = hidden[places[a]]
            for j in range(outputs):
                w = heads[column + j]
                total = np.float32(0.0)
                for k in range(units):
                    total += w[k] * h[k]
                raw[j] = total + heads_bias[column + j]
            if m < bright:
                lights[a], slope[6 * a] = softplus_of(raw[0])
            else:
                lights[a] = _intensity(raw, axes[m - bright], slope[6 * a :])
            seen += lights[a] * share[places[a]]
        brightness = level[m]  # of what is fully seen
        if len(gain):
            brightness *= gain[m]
        difference = seen * brightness - target[m]
        # a clipped pixel only says "at least"
        if target[m] >= measured.saturation[m] and difference > np.float32(0.0):
            difference = np.float32(0.0)
        squared[m] = difference * difference
        relative = difference / level[m]
        size = abs(relative)
        huber = np.float32(0.5) * size * size if size < _HUBER else _HUBER * (size - np.float32(0.5) * _HUBER)
        loss += np.float64(measured.weight[m] * huber)
        if not learn:
            continue
        pull = measured.weight[m] / level[m] * min(max(relative, -_HUBER), _HUBER)
        if len(gain):
            g_gain[m] = pull * seen * level[m]
        if len(mirrored):
            g_mirrored[m] = pull * brightness
        for a in range(surfaces):
            h, g = hidden[places[a]], g_hidden[places[a]]
            if trains[o]:
                g_share[places[a]] += pull * lights[a] * brightness
            for j in range(outputs):
                w, w_out = heads[column + j], heads_out[column + j]
                p = pull * brightness * share[places[a]] * slope[6 * a + j]
                heads_bias_out[column + j] += p
                for k in range(units):
                    w_out[k] += p * h[k]
                if trains[o]:
                    for k in range(units):
                        g[k] += p * w[k]
    return loss


@inlined()
def first_at(ray, begin):  # type: ignore[no-untyped-def]
    """The first measurement of a ray or of those after it, by bisection."""
    low, high = 0, len(ray)
    while low < high:
        middle = (low + high) // 2
        if ray[middle] < begin:
            low = middle + 1
        else:
            high = middle
    return low


class Layers(NamedTuple):
    """Weights of the two hidden layers, padded to whole tiles, (units, inputs) and turned to (inputs, units)."""

    first: np.ndarray
    first_turned: np.ndarray
    first_bias: np.ndarray
    second: np.ndarray
    second_turned: np.ndarray
    second_bias: np.ndarray


@allocating_kernel
def two_layers(first, first_bias, second, second_bias):  # type: ignore[no-untyped-def]
    """Weights (units, inputs) and biases as the kernels take them."""
    return Layers(padded(first), padded(first.T), first_bias, padded(second), padded(second.T), second_bias)


@part()
def clear_gradients(store, chunk):  # type: ignore[no-untyped-def]
    """Of weights, of one chunk."""
    store.first_out[chunk], store.second_out[chunk], store.heads_out[chunk] = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    store.first_bias_out[chunk], store.second_bias_out[chunk] = np.float32(0.0), np.float32(0.0)
    store.heads_bias_out[chunk] = np.float32(0.0)


@part()
def compare_rays(  # type: ignore[no-untyped-def]
    begin, count, ray0, slot, chunk, rays, measured, gain, mirrored, layers, heads, heads_bias, learn, store, squared, g_features, g_share,
    g_gain, g_mirrored,
):  # fmt: skip
    """The loss of some rays, at most ``CHUNK``, and its gradients where ``learn``: of weights they are added to.

    begin: the first of the rays, ray0 + begin in ``measured.ray``.
    """
    x, h1, h2, g1, g2 = store.x[slot], store.h1[slot], store.h2[slot], store.g1[slot], store.g2[slot]
    first_out, first_bias_out, second_out = store.first_out[chunk], store.first_bias_out[chunk], store.second_out[chunk]
    second_bias_out, heads_out, heads_bias_out = store.second_bias_out[chunk], store.heads_out[chunk], store.heads_bias_out[chunk]
    features, directions, degrees, behind = rays.features, rays.directions, rays.degrees, rays.behind
    width = features.shape[1]
    degree, n = np.int64(0), np.int64(count)
    ray_of, row_of, place_of = _places_of_surfaces(), _places_of_surfaces(), _places_of_surfaces()
    share, g_of = _of_surfaces(), _of_surfaces()
    g_of[:] = np.float32(0.0)
    for i in range(count):
        degree = max(degree, degrees[begin + i])  # terms of a higher one than any here are zero
        ray_of[i], row_of[i], place_of[i] = begin + i, begin + i, -1
        if behind[begin + i] >= 0:
            ray_of[n], row_of[n], place_of[i] = begin + i, behind[begin + i], n
            n += 1
    rows, inputs, used = whole(n, TILE_ROWS), width + (degree + 1) * (degree + 1), whole(width, TILE_COLS)
    units = h1.shape[1]
    clear(x, rows, whole(inputs, TILE_COLS))
    clear(g2, rows, units)
    for i in range(n):
        o, row = ray_of[i], row_of[i]
        for j in range(width):
            x[i, j] = features[row, j]
        _harmonics(directions[o, 0], directions[o, 1], directions[o, 2], degrees[o], x[i, width:])
        share[i] = rays.share[row]
    layer(n, x, inputs, layers.first_turned, layers.first_bias, h1)
    layer(n, h1, units, layers.second_turned, layers.second_bias, h2)
    span = first_at(measured.ray, ray0 + begin), first_at(measured.ray, ray0 + begin + count)
    loss = _measurements(
        ray0 + begin, span, place_of, share, h2, rays.trains_geometry[begin : begin + count], measured, gain, mirrored, heads, heads_bias,
        learn, squared, g2, g_of, g_gain, g_mirrored, heads_out, heads_bias_out,
    )  # fmt: skip
    if learn:
        layer_backward(n, h1, units, g2, h2, second_out, second_bias_out)
        clear(g1, rows, units)
        add_product(g2, layers.second, g1, rows, units, units)
        layer_backward(n, x, whole(inputs, TILE_COLS), g1, h1, first_out, first_bias_out)
        clear(x, rows, used)
        add_product(g1, layers.first, x, rows, units, used)
        for i in range(n):
            g_share[row_of[i]] = g_of[i]
            for j in range(width):
                g_features[row_of[i], j] = x[i, j]
    return loss


@kernel
def compare(  # type: ignore[no-untyped-def]
    next_task, rays, measured, gain, mirrored, layers, heads, heads_bias, learn, store, loss, squared, g_features, g_share, g_gain,
    g_mirrored,
):  # fmt: skip
    """See ``reference.compare``. ``measured.ray`` never decreases; ``gain`` and ``mirrored`` may be empty; the loss and, where
    ``learn``, the gradients of weights are per task.

    store: ``ShadingStore``, whose scratch has a slot per thread, and its gradients where there are none.
    """
    total, slot = len(rays.behind), take(next_task, 1)
    task = take(next_task, 0)
    while task < len(loss):
        of_weights = task if learn else slot
        clear_gradients(store, of_weights)
        loss[task] = 0.0
        for begin in range(task * TOGETHER * CHUNK, min(total, (task + 1) * TOGETHER * CHUNK), CHUNK):
            loss[task] += compare_rays(
                begin, min(CHUNK, total - begin), np.int64(0), slot, of_weights, rays, measured, gain, mirrored, layers, heads, heads_bias,
                learn, store, squared, g_features, g_share, g_gain, g_mirrored,
            )  # fmt: skip
        task = take(next_task, 0)


@allocating_part()
def _shade_chunk(begin, n, features, directions, degree, layers, heads, heads_bias, outputs):  # type: ignore[no-untyped-def]
    """Outputs of n rays. heads: (H, outputs), whole tiles."""
    first, second = layers.first_turned, layers.second_turned
    width, rows = features.shape[1], whole(n, TILE_ROWS)
    x = np.zeros((rows, first.shape[0]), np.float32)
    h1, h2 = np.empty((rows, first.shape[1]), np.float32), np.empty((rows, second.shape[1]), np.float32)
    out = np.zeros((rows, heads.shape[1]), np.float32)
    for i in range(n):
        o = begin + i
        for j in range(width):
            x[i, j] = features[o, j]
        _harmonics(directions[o, 0], directions[o, 1], directions[o, 2], degree, x[i, width:])
    layer(n, x, width + (degree + 1) * (degree + 1), first, layers.first_bias, h1)
    layer(n, h1, h1.shape[1], second, layers.second_bias, h2)
    add_product(h2, heads, out, rows, h2.shape[1], out.shape[1])
    for i in range(n):
        for k in range(len(heads_bias)):
            outputs[begin + i, k] = out[i, k] + heads_bias[k]


@allocating_kernel
def shade(next_task, features, directions, degree, layers, heads, heads_bias, outputs):  # type: ignore[no-untyped-def]
    """See ``reference.shade``, of rays that all have one degree."""
    rays, turned = len(features), padded(heads.T)
    begin = take(next_task, 0) * CHUNK
    while begin < rays:
        _shade_chunk(begin, min(CHUNK, rays - begin), features, directions, degree, layers, turned, heads_bias, outputs)
        begin = take(next_task, 0) * CHUNK
