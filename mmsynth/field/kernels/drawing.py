"""Drawing photosites at random, and the rays through them, in plain torch: the definition, of which ``reference`` is the rest.

Random numbers are hashes of what they are for (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"): ray i of a step has the
same ones on any device and in any order. ``scramble`` is Wellons' lowbias32, found by a search for the least bias; all arithmetic is of
unsigned 32 bits, whose products torch takes in 64.

A ray's tile is drawn first, by a table of how many of the 2³² random numbers each one has, and then a pixel of it, evenly.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import normalize

from mmsynth.field.kernels.constants import DRAW_JITTER, DRAW_PIXEL, DRAW_TILE, PURPOSE_STRIDE, WORD
from mmsynth.field.kernels.parameters import Cameras, Drawn, Frames, Measured, Modalities, Selection

_MASK = 0xFFFFFFFF


def scramble(x: Tensor) -> Tensor:
    """Unsigned 32-bit numbers, as int64, one to one."""
    x = (x ^ (x >> 16)) * 0x7FEB352D & _MASK
    x = (x ^ (x >> 15)) * 0x846CA68B & _MASK
    return x ^ (x >> 16)


def random_bits(key: tuple[int, int], number: Tensor, purpose: int) -> Tensor:
    """32 random bits, as int64, of each numbered thing.

    Args:
        key: two words of 32 bits. number: (N,) int64. purpose: what the number is for; those of one thing are independent.
    """
    return scramble(scramble(number + key[0] & _MASK) ^ (key[1] + purpose * PURPOSE_STRIDE & _MASK))


def draw(
    frames: Frames, cameras: Cameras, modalities: Modalities, selection: Selection, rays: Sequence[int], key: tuple[int, int]
) -> Drawn:
    """Random photosites of all modalities, each drawn for itself, with replacement.

    Args:
        rays: how many of each modality, N numbers. key: of random numbers, two words of 32 bits.
    Returns:
        rays and numbers; these weigh as the mean over each modality, and over the modalities of which rays are drawn.
    """
    parts = []
    begin = 0
    drawn = sum(count > 0 for count in rays)
    for n, count in enumerate(rays):
        number = torch.arange(begin, begin + count, device=frames.origin.device)
        parts.append(_drawn(frames, cameras, modalities, selection, n, drawn, number, key))
        begin += count
    measured = Measured(*(torch.cat(x) for x in zip(*(part.measured for part in parts), strict=True)))
    of_rays = {name: torch.cat([getattr(part, name) for part in parts]) for name in Drawn._fields if name != "measured"}
    return Drawn(**of_rays, measured=measured)


def _drawn(
    frames: Frames,
    cameras: Cameras,
    modalities: Modalities,
    selection: Selection,
    n: int,
    modalities_drawn: int,
    number: Tensor,
    key: tuple[int, int],
) -> Drawn:
    """The rays of one modality of those drawn; ``number``: theirs."""
    m = Modalities(*(x[n] if name not in ("pattern", "analysers") else x for name, x in modalities._asdict().items()))
    count, values, device = len(number), int(m.values), number.device
    tiles = slice(int(m.first_tile), int(modalities.first_tile[n + 1]))
    tile = tiles.start + torch.searchsorted(selection.ends[tiles].contiguous(), random_bits(key, number, DRAW_TILE), right=True)
    frame = (
        int(m.first_frame)
        + torch.searchsorted(frames.first_tile[int(m.first_frame) : int(modalities.first_frame[n + 1])].long(), tile, right=True)
        - 1
    )
    camera = frames.camera[frame].long()
    row, column = _pixel(cameras.width[camera], frames, m, selection, n, tile, frame, random_bits(key, number, DRAW_PIXEL))
    directions = torch.einsum("nij,nj->ni", frames.rotation[frame], in_camera(cameras, camera, row, column))
    target, alpha = _read(frames, frame, row * cameras.width[camera] + column, values)
    alpha = torch.where(torch.isnan(alpha), m.opaque, alpha)
    if int(m.pattern_first) >= 0:
        at = int(m.pattern_first) + row % m.pattern_height * m.pattern_width + column % m.pattern_width
        channel = m.pattern[at][:, None].long()
    else:
        channel = torch.arange(values, device=device).expand(count, values)
    axes, output = directions.new_empty(0, 3), m.output + channel
    if int(m.analyser_first) >= 0:
        axes = _axes(directions, frames.rotation[frame], m.analysers[int(m.analyser_first) + channel])
        output = m.output.expand(count, values)
    of_all = lambda value: value.expand(count * values).contiguous()
    ray_weight = selection.weight[tile]
    measured = Measured(
        target.reshape(-1), number.repeat_interleave(values), output.reshape(-1).long(), axes, of_all(m.level), of_all(m.saturation),
        (ray_weight / (modalities_drawn * count * values)).repeat_interleave(values),
    )  # fmt: skip
    jitter = (random_bits(key, number, DRAW_JITTER) >> 8).to(directions.dtype) * 2.0**-24
    return Drawn(frames.origin[frame], directions, jitter, alpha, ray_weight, tile, frame.repeat_interleave(values), measured)


def _pixel(
    width: Tensor, frames: Frames, m: Modalities, selection: Selection, n: int, tile: Tensor, frame: Tensor, bits: Tensor
) -> tuple[Tensor, Tensor]:
    """Row and column of the pixel of each tile that its random bits say."""
    tile_width, tile_height = m.tile_width.long(), m.tile_height.long()
    down, across = (lambda local, columns: (local // columns, local % columns))(
        tile - frames.first_tile[frame], (width + tile_width - 1) // tile_width
    )
    kth = bits * selection.pixels[tile].long() >> 32
    if int(selection.first_word[n]) < 0:
        columns = torch.minimum(tile_width, width - across * tile_width)
        return down * tile_height + kth // columns, across * tile_width + kth % columns
    per_tile = int(tile_width * tile_height) // WORD
    first = int(selection.first_word[n]) + (tile - int(m.first_tile)) * per_tile
    words = selection.words[first[:, None] + torch.arange(per_tile, device=tile.device)].long()
    chosen = (words[..., None] >> torch.arange(WORD, device=tile.device) & 1).flatten(1)
    at = (chosen.cumsum(1) > kth[:, None]).int().argmax(1)
    return down * tile_height + at // tile_width, across * tile_width + at % tile_width


def in_camera(cameras: Cameras, camera: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Unit directions in the camera's axes, (N, 3): of nodes, or between them by Lagrange's cubic through 4 x 4."""
    step, across = cameras.step[camera].long(), cameras.across[camera].long()
    at_column, columns = _cubic(column, step, across, cameras.nodes.dtype)
    at_row, rows = _cubic(row, step, cameras.down[camera].long(), cameras.nodes.dtype)
    first = cameras.first[camera] + at_row * across + at_column
    found = torch.zeros(len(camera), 3, dtype=cameras.nodes.dtype, device=camera.device)
    for j in range(4):
        for i in range(4):
            node = torch.where(step > 1, first + j * across + i, first)
            found = found + (rows[:, j] * columns[:, i])[:, None] * cameras.nodes[node]
    return torch.where((step > 1)[:, None], normalize(found, dim=-1), cameras.nodes[first])


def _cubic(pixel: Tensor, step: Tensor, nodes: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The first of four nodes around a pixel, and their weights (N, 4)."""
    first = torch.where(step > 1, torch.minimum((pixel // step - 1).clamp(min=0), nodes - 4), pixel)
    t = (pixel.double() / step - first).to(dtype)
    a, b, c = t - 1.0, t - 2.0, t - 3.0
    return first, torch.stack([-a * b * c / 6.0, t * b * c / 2.0, -t * a * c / 2.0, t * a * b / 6.0], -1)


def _read(frames: Frames, frame: Tensor, pixel: Tensor, values: int) -> tuple[Tensor, Tensor]:
    """Values (N, K) of pixels, 1.0 = full scale, and alpha (N,), NaN where none is stored; with alpha what the object adds to black."""
    stride, kind = frames.stride[frame].long(), frames.kind[frame]
    first = frames.start[frame] + pixel * stride
    has_alpha = stride > values
    at = torch.cat([first[:, None] + torch.arange(values, device=pixel.device), (first + torch.where(has_alpha, values, 0))[:, None]], 1)
    found = torch.empty(at.shape, dtype=frames.origin.dtype, device=pixel.device)
    signed = frames.codes16.view(torch.int16)  # torch indexes no uint16 on a GPU
    for k, (stored, scale) in enumerate(((frames.codes8, 255.0), (signed, 65535.0), (frames.floats, 1.0))):
        of_kind = kind == k
        codes = stored[at[of_kind]]
        found[of_kind] = (codes.int() & 0xFFFF if stored is signed else codes).to(found.dtype) / scale
    target, alpha = found[:, :values], torch.where(has_alpha, found[:, values], torch.nan)
    return torch.where(has_alpha[:, None], target * alpha[:, None], target), alpha


def _axes(directions: Tensor, rotation: Tensor, analysers: Tensor) -> Tensor:
    """Axes of analysers (N, K, 2) in the ray's own reference axes, (N K, 3): ``sensors.polarization.analyser_axes``, ideal."""
    x = rotation[:, :, 0] - (rotation[:, :, 0] * directions).sum(-1, keepdim=True) * directions
    x = normalize(x, dim=-1)
    y = torch.linalg.cross(x, directions)
    return (analysers[..., :1] * x[:, None] + analysers[..., 1:] * y[:, None]).reshape(-1, 3)


def odds(residual: Tensor, count: Tensor, first_tile: Tensor, evenly: float) -> tuple[Tensor, Tensor]:
    """How often tiles are drawn: ``ends`` and ``weight`` of ``Selection``.

    A pixel's density, relative to even draws, is ``evenly + (1 - evenly) r / mean(r)``, the mean over the modality's pixels; 1 where all
    residuals are 0.

    Args:
        residual, count: (T,), of each tile, and the pixels that may be drawn in it, at least one in each modality.
        first_tile: (N + 1,), of each modality.
    """
    ends, weight = torch.empty_like(residual, dtype=torch.int64), torch.empty_like(residual)
    for begin, end in pairwise(first_tile.tolist()):
        pixels, r = count[begin:end].double(), residual[begin:end].double()
        mean = (r * pixels).sum() / pixels.sum()
        density = evenly + (1.0 - evenly) * torch.where(mean > 0, r / mean, 1.0)
        upto = (density * pixels).cumsum(0)
        of_all = (upto / upto[-1] * 2.0**32).long()
        of_all[upto == upto[-1]] = 1 << 32  # tiles after the last pixel have none
        share = of_all.diff(prepend=of_all.new_zeros(1)).double() / 2.0**32
        ends[begin:end] = of_all
        weight[begin:end] = torch.where(share > 0, pixels / (share * pixels.sum()), 0.0)
    return ends, weight
