"""Where a step asks for ∇sdf, and what it makes of it, in Triton: points of all space, those beside or on the surfaces that rays meet, and
pairs of neighbours; the eikonal term of the loss and the pull between normals with their gradients, and the normals of mirrors."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from mmsynth.field.kernels.constants import SOFT_EDGE
from mmsynth.field.kernels.cuda.shared import back_to_world, contracted, jit, position, tl, triton
from mmsynth.field.kernels.learning import pairs_of
from mmsynth.field.kernels.parameters import Eikonal, Hits, Rays, Smooth

BLOCK = 128


@jit
def _store(to, i, x, y, z, mask):  # type: ignore[no-untyped-def]
    tl.store(to + 3 * i, x, mask=mask)
    tl.store(to + 3 * i + 1, y, mask=mask)
    tl.store(to + 3 * i + 2, z, mask=mask)


@jit
def _norm(x, y, z):  # type: ignore[no-untyped-def]
    return tl.sqrt(x * x + y * y + z * z)


@jit
def places_kernel(  # type: ignore[no-untyped-def]
    origins, directions, distance, depth, share, given, noise, aside, at, epsilons, points, mirroring, paired,
    epsilon, mirror_epsilon, smooth_epsilon, rays, rows, count, asked, pairs,
    MIRRORS: tl.constexpr, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """at: ``count`` given points, then the surfaces of all ``rows``, or beside those of ``asked`` of the ``rays``; last those of ``pairs``
    of the rays, and their neighbours."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    k = i - count
    free = i < count
    x, y, z = position(given, i, free)
    far = tl.where(free, epsilon, 0.0)
    if MIRRORS:
        more = (k >= 0) & (k < rows)
        ray = tl.where(k < rays, k, k - rays)  # with two rows for every ray
        t = tl.load(distance + k, mask=more, other=0.0)
        met = more & (t > 0.0)
        nx, ny, nz = 0.0 * x, 0.0 * x, 0.0 * x
    else:
        more = (k >= 0) & (k < asked)
        ray = (k.to(tl.int64) * rays // tl.maximum(asked, 1)).to(tl.int32)
        t = tl.load(depth + ray, mask=more, other=0.0)
        met = more & (t == t)
        nx, ny, nz = position(noise, k, more)
    ox, oy, oz = position(origins, ray, met)
    dx, dy, dz = position(directions, ray, met)
    t = tl.where(met, t, 0.0)
    px, py, pz = ox + dx * t, oy + dy * t, oz + dz * t
    if MIRRORS:
        _store(points, k, px, py, pz, more)
        tl.store(mirroring + k, tl.load(share + k, mask=met, other=0.0), mask=more)  # without a place there is no normal
    px, py, pz, _ = contracted(px, py, pz, CONTRACTED)
    _store(at, i, tl.where(free, x, px + nx), tl.where(free, y, py + ny), tl.where(free, z, pz + nz), free | more)
    tl.store(epsilons + i, tl.where(met, mirror_epsilon if MIRRORS else epsilon, far), mask=free | more)
    j = k - (rows if MIRRORS else asked)
    neighbour = (j >= 0) & (j < 2 * pairs)
    pair = tl.where(j < pairs, j, j - pairs)
    ray = (pair.to(tl.int64) * rays // tl.maximum(pairs, 1)).to(tl.int32)
    t = tl.load(depth + ray, mask=neighbour, other=0.0)
    met = neighbour & (t == t)
    t = tl.where(met, t, 0.0)
    ox, oy, oz = position(origins, ray, met)
    dx, dy, dz = position(directions, ray, met)
    px, py, pz = ox + dx * t, oy + dy * t, oz + dz * t
    ax, ay, az = position(aside, pair, neighbour)
    r = _norm(px, py, pz)
    qx, qy, qz = px + ax * r, py + ay * r, pz + az * r
    outside = met & (r > 1.0) & (_norm(qx, qy, qz) > 1.0)
    px, py, pz = tl.where(j < pairs, px, qx), tl.where(j < pairs, py, qy), tl.where(j < pairs, pz, qz)
    _store(paired, j, px, py, pz, neighbour)
    px, py, pz, _ = contracted(px, py, pz, CONTRACTED)
    _store(at, i, px, py, pz, neighbour)
    tl.store(epsilons + i, tl.where(outside, smooth_epsilon, 0.0), mask=neighbour)


@jit
def _eikonal(  # type: ignore[no-untyped-def]
    program, slopes, at, epsilons, points, loss, gradient, normals, weight, shallow, count, rows,
    MIRRORS: tl.constexpr, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """weight: of one point. rows: of all, beside the ``count`` points of all space."""
    i = program * BLOCK + tl.arange(0, BLOCK)
    k = i - count
    live = i < count + rows
    x, y, z = position(slopes, i, live)
    used = live & (tl.load(epsilons + i, mask=live, other=0.0) > 0.0)
    length = _norm(x, y, z)
    off = length - 1.0
    px, py, pz = position(at, i, live)
    within = _norm(px, py, pz) < 1.0
    if MIRRORS:
        mirrors = live & (k >= 0)
        within = within & (k < 0)
        qx, qy, qz = position(points, k, mirrors)
        vx, vy, vz = back_to_world(qx, qy, qz, x, y, z, CONTRACTED)
        norm = tl.maximum(_norm(vx, vy, vz), 1e-12)
        _store(normals, k, vx / norm, vy / norm, vz / norm, mirrors)
    factor = tl.where(used, weight * tl.where((off < 0.0) & within, shallow, 1.0), 0.0)
    tl.store(loss + program, tl.sum(tl.where(used, factor * off * off, 0.0).to(tl.float64), 0))
    g = tl.where(length > 0.0, 2.0 * factor * off / length, 0.0)
    g = tl.where(used, g, 0.0)
    _store(gradient, i, g * x, g * y, g * z, live)


@jit
def normals_backward_kernel(  # type: ignore[no-untyped-def]
    slopes, points, g_normals, gradient, count, rows, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr
):
    """Of the ``rows`` slopes behind the first ``count``; ``gradient`` is added to."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = k < rows
    px, py, pz = position(points, k, live)
    x, y, z, norm = _normal(slopes, count + k, px, py, pz, live, CONTRACTED)
    gx, gy, gz = position(g_normals, k, live)
    gx, gy, gz = _from_normal(px, py, pz, x, y, z, norm, gx, gy, gz, CONTRACTED)
    some = live & ((gx != 0.0) | (gy != 0.0) | (gz != 0.0))  # what is not met has no slope either
    bx, by, bz = position(gradient, count + k, some)
    _store(gradient, count + k, bx + gx, by + gy, bz + gz, some)


@jit
def _normal(slopes, i, px, py, pz, live, CONTRACTED: tl.constexpr):  # type: ignore[no-untyped-def]
    """Of the slope in row i, at a point of the world: the unit normal, and what it was divided by."""
    x, y, z = position(slopes, i, live)
    x, y, z = back_to_world(px, py, pz, x, y, z, CONTRACTED)
    norm = tl.maximum(_norm(x, y, z), 1e-12)
    return x / norm, y / norm, z / norm, norm


@jit
def _from_normal(px, py, pz, nx, ny, nz, norm, gx, gy, gz, CONTRACTED: tl.constexpr):  # type: ignore[no-untyped-def]
    """Gradient to a slope from the gradient to its normal."""
    along = gx * nx + gy * ny + gz * nz
    gx, gy, gz = (gx - along * nx) / norm, (gy - along * ny) / norm, (gz - along * nz) / norm
    return back_to_world(px, py, pz, gx, gy, gz, CONTRACTED)  # the contraction's Jacobian is symmetric


@jit
def _pairs(  # type: ignore[no-untyped-def]
    program, slopes, epsilons, paired, loss, gradient, weight, edge, first, pairs, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr
):
    """first: row of the first pair. weight: of one."""
    k = program * BLOCK + tl.arange(0, BLOCK)
    live = k < pairs
    used = live & (tl.load(epsilons + first + k, mask=live, other=0.0) > 0.0)
    px, py, pz = position(paired, k, used)
    qx, qy, qz = position(paired, k + pairs, used)
    nx, ny, nz, norm = _normal(slopes, first + k, px, py, pz, used, CONTRACTED)
    mx, my, mz, other = _normal(slopes, first + pairs + k, qx, qy, qz, used, CONTRACTED)
    x, y, z = nx - mx, ny - my, nz - mz
    apart = 0.5 * (x * x + y * y + z * z)
    soft = apart + edge
    tl.store(loss + program, tl.sum(tl.where(used, weight * apart / soft, 0.0).to(tl.float64), 0))
    pull = tl.where(used, weight * edge / (soft * soft), 0.0)
    x, y, z = pull * x, pull * y, pull * z
    gx, gy, gz = _from_normal(px, py, pz, nx, ny, nz, norm, x, y, z, CONTRACTED)
    hx, hy, hz = _from_normal(qx, qy, qz, mx, my, mz, other, -x, -y, -z, CONTRACTED)
    _store(gradient, first + k, tl.where(used, gx, 0.0), tl.where(used, gy, 0.0), tl.where(used, gz, 0.0), live)
    _store(gradient, first + pairs + k, tl.where(used, hx, 0.0), tl.where(used, hy, 0.0), tl.where(used, hz, 0.0), live)


@jit
def terms_kernel(  # type: ignore[no-untyped-def]
    slopes, at, epsilons, points, paired, loss, gradient, normals, weight, shallow, smooth_weight, edge, count, rows, pairs, programs,
    MIRRORS: tl.constexpr, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """programs: of the eikonal term; those behind them are of pairs."""
    program = tl.program_id(0)
    if program < programs:
        _eikonal(program, slopes, at, epsilons, points, loss, gradient, normals, weight, shallow, count, rows, MIRRORS, CONTRACTED, BLOCK)
    else:
        _pairs(
            program - programs, slopes, epsilons, paired, loss + programs, gradient, smooth_weight, edge, count + rows, pairs, CONTRACTED,
            BLOCK,
        )  # fmt: skip


class Places(NamedTuple):
    """Where ∇sdf is asked for, frame of the grid: at (N, 3), epsilons (N,) of the differences, 0: this one is not asked. Of surfaces, where
    they mirror: points (H, 3), normalised frame, share (H,) of those that have a place; else (0, 3) and (0,). paired (2 K, 3), the same, of
    the last 2 K places: K surfaces, and their neighbours."""

    at: Tensor
    epsilons: Tensor
    points: Tensor
    share: Tensor
    paired: Tensor


class Slopes(NamedTuple):
    """Of ∇sdf at ``Places``: gradient (N, 3) of the loss; normals (H, 3) of mirrors."""

    gradient: Tensor
    normals: Tensor


def places(hits: Hits, rays: Rays, eikonal: Eikonal, smooth: Smooth, extent: float, mirrors: bool) -> Places:
    """Points of all space, then surfaces, then pairs; ``mirrors``: all surfaces, which have two rows for every ray. One launch."""
    count, rows, asked = len(eikonal.points), len(hits.share), min(len(eikonal.noise), len(rays.origins))
    pairs = pairs_of(len(rays.origins), smooth)
    total = count + (rows if mirrors else asked) + 2 * pairs
    new = lambda *shape: torch.empty(shape, device=hits.share.device)
    out = Places(new(total, 3), new(total), new(rows if mirrors else 0, 3), new(rows if mirrors else 0), new(2 * pairs, 3))
    with torch.cuda.device_of(out.at):
        places_kernel[(triton.cdiv(total, BLOCK),)](
            rays.origins, rays.directions, hits.distance, hits.depth, hits.share, eikonal.points, eikonal.noise, smooth.aside, *out,
            eikonal.epsilon, eikonal.mirror_epsilon, smooth.epsilon, len(rays.origins), rows, count, asked, pairs, mirrors, extent > 1.0,
            BLOCK,
        )  # fmt: skip
    return out


def slopes_programs(where: Places) -> tuple[int, int]:
    """How many sums ``terms_of_slopes`` makes: of the eikonal term, of pairs."""
    paired = len(where.paired)
    return triton.cdiv(len(where.at) - paired, BLOCK), triton.cdiv(paired // 2, BLOCK)


def terms_of_slopes(slopes: Tensor, where: Places, eikonal: Eikonal, smooth: Smooth, extent: float, loss: Tensor) -> Slopes:
    """The gradient of the eikonal term and of the pull between normals, and normals; loss (sum of ``slopes_programs``,) float64 is set to
    parts of both. One launch."""
    count, paired, mirrors = len(eikonal.points), len(where.paired), len(where.points) > 0
    rows = len(slopes) - count - paired
    out = Slopes(torch.empty_like(slopes), torch.empty_like(where.points))
    first, second = slopes_programs(where)
    with torch.cuda.device_of(slopes):
        terms_kernel[(first + second,)](
            slopes, where.at, where.epsilons, where.points, where.paired, loss, *out,
            eikonal.weight / max(asked_points(where, eikonal), 1), eikonal.shallow, smooth.weight / max(paired // 2, 1), SOFT_EDGE,
            count, rows, paired // 2, first, mirrors, extent > 1.0, BLOCK,
        )  # fmt: skip
    return out


def asked_points(where: Places, eikonal: Eikonal) -> int:
    """By how many the eikonal term is divided, see ``Eikonal``: its points and the rays that are asked, met or not."""
    more = len(where.points) // 2 if len(where.points) else len(eikonal.noise)
    return len(eikonal.points) + more


def normals_backward(slopes: Tensor, where: Places, g_normals: Tensor, gradient: Tensor, extent: float) -> None:
    """Add the gradient of slopes that normals of mirrors have; one launch."""
    rows = len(where.points)
    count = len(slopes) - rows - len(where.paired)
    with torch.cuda.device_of(slopes):
        normals_backward_kernel[(triton.cdiv(rows, BLOCK),)](slopes, where.points, g_normals, gradient, count, rows, extent > 1.0, BLOCK)
