"""Photosites drawn at random, and the rays through them, in Triton: see ``drawing``. The same random numbers, and the same pixels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

from mmsynth.field.kernels import constants
from mmsynth.field.kernels.cuda.shared import constant, jit, tl, triton
from mmsynth.field.kernels.parameters import Cameras, Drawn, Frames, Measured, Modalities, Selection

BLOCK = 128
TILE, PIXEL, JITTER = (constant(x) for x in (constants.DRAW_TILE, constants.DRAW_PIXEL, constants.DRAW_JITTER))
STRIDE, WORD = constant(constants.PURPOSE_STRIDE), constant(constants.WORD)


@jit
def scramble(x):  # type: ignore[no-untyped-def]
    """uint32 → uint32, one to one; products wrap."""
    x = tl.mul(x ^ (x >> 16), tl.full([1], 0x7FEB352D, tl.uint32), sanitize_overflow=False)
    x = tl.mul(x ^ (x >> 15), tl.full([1], 0x846CA68B, tl.uint32), sanitize_overflow=False)
    return x ^ (x >> 16)


@jit
def random_bits(key, number, PURPOSE: tl.constexpr):  # type: ignore[no-untyped-def]
    """See ``drawing.random_bits``: int32 numbers → uint32. key: int64 words."""
    first = tl.add(number.to(tl.uint32), tl.load(key).to(tl.uint32), sanitize_overflow=False)
    second = (tl.load(key + 1) + PURPOSE * STRIDE).to(tl.uint32)
    return scramble(scramble(first) ^ second)


@jit
def unit(bits):  # type: ignore[no-untyped-def]
    """In [0, 1)."""
    return (bits >> 8).to(tl.float32) * 5.9604644775390625e-08


@jit
def _ones(x):  # type: ignore[no-untyped-def]
    """How many bits of uint32 are set."""
    x = x - ((x >> 1) & 0x55555555)
    x = (x & 0x33333333) + ((x >> 2) & 0x33333333)
    x = (x + (x >> 4)) & 0x0F0F0F0F
    x = x + (x >> 8)
    return ((x + (x >> 16)) & 0x3F).to(tl.int32)


@jit
def _bit(word, k):  # type: ignore[no-untyped-def]
    """Where the k-th set bit of uint32 is, from 0."""
    at = k * 0
    for i in tl.static_range(5):
        width = 16 >> i
        low = _ones((word >> at.to(tl.uint32)) & ((1 << width) - 1))
        beyond = k >= low
        at = tl.where(beyond, at + width, at)
        k = tl.where(beyond, k - low, k)
    return at


@jit
def _pixel(selection_count, words, first_word, tile, first_tile, across, down, width, tile_width, tile_height, bits, live):  # type: ignore[no-untyped-def]
    """Row and column of the pixel of each tile that its random bits say; across, down: of the tile in its frame."""
    k = ((bits.to(tl.int64) * tl.load(selection_count + tile, mask=live, other=0).to(tl.int64)) >> 32).to(tl.int32)
    columns = tl.maximum(tl.minimum(tile_width, width - across * tile_width), 1)
    row, column = k // columns, k % columns
    if first_word >= 0:
        per_tile = tile_width * tile_height // WORD
        begin = words + first_word + (tile - first_tile).to(tl.int64) * per_tile
        own, place, left = k.to(tl.uint32) * 0, k * 0, k
        passed = k * 0
        for w in range(0, per_tile):
            word = tl.load(begin + w, mask=live, other=0).to(tl.uint32, bitcast=True)
            some = _ones(word)
            here = (k >= passed) & (k < passed + some)
            own = tl.where(here, word, own)
            place = tl.where(here, w * WORD, place)
            left = tl.where(here, k - passed, left)
            passed += some
        b = place + _bit(own, left)
        row, column = b // tile_width, b % tile_width
    return down * tile_height + row, across * tile_width + column


@jit
def _between(pixel, step, nodes):  # type: ignore[no-untyped-def]
    """The first of four nodes around a pixel, and how far behind it that is, in nodes."""
    first = tl.where(step > 1, tl.minimum(tl.maximum(pixel // step - 1, 0), nodes - 4), pixel)
    return first, (pixel - first * step).to(tl.float32) / step.to(tl.float32)


@jit
def _weight(t, NODE: tl.constexpr):  # type: ignore[no-untyped-def]
    """Of Lagrange's cubic."""
    a, b, c = t - 1.0, t - 2.0, t - 3.0
    if NODE == 0:
        return -a * b * c / 6.0
    elif NODE == 1:
        return t * b * c / 2.0
    elif NODE == 2:
        return -t * a * c / 2.0
    return t * a * b / 6.0


@jit
def _in_camera(step, first, across, down, nodes, row, column, live):  # type: ignore[no-untyped-def]
    """Unit directions in the camera's axes."""
    i, s = _between(column, step, across)
    j, t = _between(row, step, down)
    begin = nodes + 3 * (first + j.to(tl.int64) * across + i)
    x = tl.load(begin, mask=live, other=0.0)
    y = tl.load(begin + 1, mask=live, other=0.0)
    z = tl.load(begin + 2, mask=live, other=1.0)
    coarse = live & (step > 1)
    if tl.max(coarse.to(tl.int32), 0) > 0:
        cx, cy, cz = 0.0 * x, 0.0 * x, 0.0 * x
        for q in tl.static_range(4):
            for p in tl.static_range(4):
                node = begin + 3 * (q * across.to(tl.int64) + p)
                w = _weight(t, q) * _weight(s, p)
                cx += w * tl.load(node, mask=coarse, other=0.0)
                cy += w * tl.load(node + 1, mask=coarse, other=0.0)
                cz += w * tl.load(node + 2, mask=coarse, other=0.0)
        norm = tl.maximum(tl.sqrt(cx * cx + cy * cy + cz * cz), 1e-12)
        x = tl.where(coarse, cx / norm, x)
        y = tl.where(coarse, cy / norm, y)
        z = tl.where(coarse, cz / norm, z)
    return x, y, z


@jit
def _decode(codes8, codes16, floats, kind, at, live):  # type: ignore[no-untyped-def]
    """A stored value, 1.0 = full scale."""
    a = tl.load(codes8 + at, mask=live & (kind == 0), other=0).to(tl.float32) / 255.0
    b = tl.load(codes16 + at, mask=live & (kind == 1), other=0).to(tl.float32) / 65535.0
    return tl.where(kind == 0, a, tl.where(kind == 1, b, tl.load(floats + at, mask=live & (kind == 2), other=0.0)))


@jit
def draw_kernel(  # type: ignore[no-untyped-def]
    start, kind, stride_of, camera_of, first_tiles, rotation, origin, codes8, codes16, floats,
    widths, steps, first_node, nodes_across, nodes_down, nodes,
    first_frame_of, first_tile_of, tile_widths, tile_heights, values_of, output_of, pattern_of, pattern_heights, pattern_widths, pattern,
    level_of, saturation_of, opaque_of, analyser_of, analysers,
    ends, tile_weight, selection_count, first_word, words,
    begins, key, origins, directions, jitter, alpha, ray_weight, tiles,
    frames, target, rays, output, axes, level, saturation, weight,
    drawn, tile_bisections, frame_bisections, BLOCK: tl.constexpr,
):  # fmt: skip
    """begins: (3, N + 1), of each modality the first ray, number and number of polarization. drawn: modalities of which there are rays."""
    n = tl.program_id(0)
    modalities = tl.num_programs(0)
    first_ray = tl.load(begins + n).to(tl.int32)
    count = tl.load(begins + n + 1).to(tl.int32) - first_ray
    local = tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    live = local < count
    i = first_ray + local
    # the tile: the first of the modality whose end is beyond the random number; the frame: the last that begins before it
    bits = random_bits(key, i, TILE).to(tl.int64)
    low = tl.load(first_tile_of + n) + local * 0
    high = tl.load(first_tile_of + n + 1) - 1 + local * 0
    for _ in range(0, tile_bisections):
        middle = (low + high) // 2
        beyond = (low < high) & (tl.load(ends + middle, mask=live, other=0) <= bits)
        low, high = tl.where(beyond, middle + 1, low), tl.where(beyond, high, tl.maximum(middle, low))
    tile = low
    low = tl.load(first_frame_of + n) + local * 0
    high = tl.load(first_frame_of + n + 1) - 1 + local * 0
    for _ in range(0, frame_bisections):
        middle = (low + high + 1) // 2
        before = (low < high) & (tl.load(first_tiles + middle, mask=live, other=0) <= tile)
        low, high = tl.where(before, middle, low), tl.where(before | (low >= high), high, middle - 1)
    frame = low
    camera = tl.load(camera_of + frame, mask=live, other=0)
    width = tl.load(widths + camera, mask=live, other=1)
    tile_width, tile_height = tl.load(tile_widths + n), tl.load(tile_heights + n)
    of_row = (width + tile_width - 1) // tile_width
    here = tile - tl.load(first_tiles + frame, mask=live, other=0)
    row, column = _pixel(
        selection_count, words, tl.load(first_word + n), tile, tl.load(first_tile_of + n), here % of_row, here // of_row, width,
        tile_width, tile_height, random_bits(key, i, PIXEL), live,
    )  # fmt: skip
    x, y, z = _in_camera(
        tl.load(steps + camera, mask=live, other=1), tl.load(first_node + camera, mask=live, other=0),
        tl.load(nodes_across + camera, mask=live, other=4), tl.load(nodes_down + camera, mask=live, other=4), nodes, row, column, live,
    )  # fmt: skip
    turn = rotation + 9 * frame
    r0 = tl.load(turn, mask=live, other=1.0)
    r3 = tl.load(turn + 3, mask=live, other=0.0)
    r6 = tl.load(turn + 6, mask=live, other=0.0)
    dx = r0 * x + tl.load(turn + 1, mask=live, other=0.0) * y + tl.load(turn + 2, mask=live, other=0.0) * z
    dy = r3 * x + tl.load(turn + 4, mask=live, other=0.0) * y + tl.load(turn + 5, mask=live, other=0.0) * z
    dz = r6 * x + tl.load(turn + 7, mask=live, other=0.0) * y + tl.load(turn + 8, mask=live, other=0.0) * z
    own_weight = tl.load(tile_weight + tile, mask=live, other=0.0)
    for k in tl.static_range(3):
        tl.store(origins + 3 * i + k, tl.load(origin + 3 * frame + k, mask=live, other=0.0), mask=live)
    tl.store(directions + 3 * i, dx, mask=live)
    tl.store(directions + 3 * i + 1, dy, mask=live)
    tl.store(directions + 3 * i + 2, dz, mask=live)
    tl.store(jitter + i, unit(random_bits(key, i, JITTER)), mask=live)
    tl.store(ray_weight + i, own_weight, mask=live)
    tl.store(tiles + i, tile.to(tl.int64), mask=live)
    values, stride = tl.load(values_of + n), tl.load(stride_of + frame, mask=live, other=1)
    stored = tl.load(kind + frame, mask=live, other=0)
    at = tl.load(start + frame, mask=live, other=0) + (row.to(tl.int64) * width + column) * stride
    has_alpha = live & (stride > values)
    opacity = tl.where(has_alpha, _decode(codes8, codes16, floats, stored, at + values, has_alpha), 1.0)
    known = tl.where(has_alpha & (opacity == opacity), opacity, tl.load(opaque_of + n))
    tl.store(alpha + i, known, mask=live)
    mosaic, analyser, column0 = tl.load(pattern_of + n), tl.load(analyser_of + n), tl.load(output_of + n)
    own_level, own_saturation = tl.load(level_of + n), tl.load(saturation_of + n)
    # reference axes of the ray, across the camera's x
    along = r0 * dx + r3 * dy + r6 * dz
    ax, ay, az = r0 - along * dx, r3 - along * dy, r6 - along * dz
    norm = tl.maximum(tl.sqrt(ax * ax + ay * ay + az * az), 1e-12)
    ax, ay, az = ax / norm, ay / norm, az / norm
    bx, by, bz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
    first_number = tl.load(begins + modalities + 1 + n)
    first_axis = tl.load(begins + 2 * (modalities + 1) + n)
    for j in range(0, values):
        m = first_number + local.to(tl.int64) * values + j
        channel = local * 0 + j
        if mosaic >= 0:
            high_, wide = tl.load(pattern_heights + n), tl.load(pattern_widths + n)
            channel = tl.load(pattern + mosaic + row % high_ * wide + column % wide, mask=live, other=0)
        value = _decode(codes8, codes16, floats, stored, at + j, live)
        tl.store(target + m, tl.where(has_alpha, value * opacity, value), mask=live)
        tl.store(rays + m, i.to(tl.int64), mask=live)
        tl.store(frames + m, frame.to(tl.int64), mask=live)
        tl.store(level + m, own_level, mask=live)
        tl.store(saturation + m, own_saturation, mask=live)
        tl.store(weight + m, own_weight / (drawn * count * values).to(tl.float32), mask=live)
        if analyser >= 0:
            c = tl.load(analysers + 2 * (analyser + channel), mask=live, other=1.0)
            s = tl.load(analysers + 2 * (analyser + channel) + 1, mask=live, other=0.0)
            e = axes + 3 * (first_axis + local.to(tl.int64) * values + j)
            tl.store(e, c * ax + s * bx, mask=live)
            tl.store(e + 1, c * ay + s * by, mask=live)
            tl.store(e + 2, c * az + s * bz, mask=live)
            tl.store(output + m, (column0 + channel * 0).to(tl.int64), mask=live)
        else:
            tl.store(output + m, (column0 + channel).to(tl.int64), mask=live)


def begins_of(values: Sequence[int], polarized: Sequence[bool], rays: Sequence[int]) -> list[list[int]]:
    """Of each modality, and behind the last, the first ray, number and number of polarization: (3, N + 1).

    Args:
        values: measured along each ray. rays: how many.
    """
    numbers = [v * r for v, r in zip(values, rays, strict=True)]
    axes = [n * p for n, p in zip(numbers, polarized, strict=True)]
    return [list(accumulate(counts, initial=0)) for counts in (rays, numbers, axes)]


def draw_all(
    frames: Frames, cameras: Cameras, modalities: Modalities, selection: Selection, begins: Tensor, sizes: tuple[int, int, int, int],
    drawn: int, key: Tensor, into: tuple[Tensor, Tensor, Tensor] | None = None,
) -> Drawn:  # fmt: skip
    """``draw`` whose shapes are known to the host; one launch.

    Args:
        begins: (3, N + 1) int64, see ``begins_of``. sizes: rays, numbers, numbers of polarization, and the most rays of a modality.
        drawn: modalities of which there are rays. key: (2,) int64, two words of 32 bits. into: where origins, directions (R, 3) and jitter
            (R,) go, None: anew.
    """
    rays, numbers, axes, most = sizes
    device = frames.origin.device
    new = lambda *shape, dtype=torch.float32: torch.empty(shape, dtype=dtype, device=device)
    whole = lambda count: new(count, dtype=torch.int64)
    out = Drawn(
        *((new(rays, 3), new(rays, 3), new(rays)) if into is None else into), new(rays), new(rays), whole(rays), whole(numbers),
        Measured(new(numbers), whole(numbers), whole(numbers), new(axes, 3), new(numbers), new(numbers), new(numbers)),
    )  # fmt: skip
    if rays:
        with torch.cuda.device_of(out.jitter):
            draw_kernel[(len(modalities.values), triton.cdiv(most, BLOCK))](
                *frames, *cameras, *modalities, *selection, begins, key, *out[:-1], *out.measured,
                drawn, len(selection.ends).bit_length(), len(frames.start).bit_length(), BLOCK,
            )  # fmt: skip
    return out


def draw(
    frames: Frames, cameras: Cameras, modalities: Modalities, selection: Selection, rays: Sequence[int], key: tuple[int, int]
) -> Drawn:
    """See ``drawing.draw``; float32. The host asks for the modalities' numbers of values."""
    begins = begins_of(modalities.values.tolist(), (modalities.analyser_first >= 0).tolist(), rays)
    table = torch.tensor(begins, device=frames.origin.device)
    sizes = begins[0][-1], begins[1][-1], begins[2][-1], max(rays, default=0)
    drawn = sum(count > 0 for count in rays)
    return draw_all(frames, cameras, modalities, selection, table, sizes, drawn, torch.tensor(key, device=frames.origin.device))
