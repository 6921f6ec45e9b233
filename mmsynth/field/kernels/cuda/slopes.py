"""Where a step asks for ∇sdf, and what it makes of it, in Triton: points of all space, and beside or on the surfaces that rays meet; the
eikonal term of the loss with its gradient, and the normals of mirrors."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from mmsynth.field.kernels.cuda.shared import back_to_world, contracted, jit, position, tl, triton
from mmsynth.field.kernels.parameters import Eikonal, Hits, Rays

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
    origins, directions, distance, depth, share, given, noise, at, epsilons, points, mirroring,
    epsilon, mirror_epsilon, rays, rows, count, asked,
    MIRRORS: tl.constexpr, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """at: ``count`` given points, then the surfaces of all ``rows``, or beside those of ``asked`` of the ``rays``."""
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


@jit
def eikonal_kernel(  # type: ignore[no-untyped-def]
    slopes, at, epsilons, points, loss, gradient, normals, weight, shallow, count, rows,
    MIRRORS: tl.constexpr, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """weight: of one point. rows: of all, beside the ``count`` points of all space."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
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
    tl.store(loss + tl.program_id(0), tl.sum(tl.where(used, factor * off * off, 0.0).to(tl.float64), 0))
    g = tl.where(length > 0.0, 2.0 * factor * off / length, 0.0)
    g = tl.where(used, g, 0.0)
    _store(gradient, i, g * x, g * y, g * z, live)


@jit
def normals_backward_kernel(  # type: ignore[no-untyped-def]
    slopes, points, g_normals, gradient, count, rows, CONTRACTED: tl.constexpr, BLOCK: tl.constexpr
):
    """Of the slopes behind the first ``count``; ``gradient`` is added to."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = k < rows
    x, y, z = position(slopes, count + k, live)
    px, py, pz = position(points, k, live)
    x, y, z = back_to_world(px, py, pz, x, y, z, CONTRACTED)
    norm = tl.maximum(_norm(x, y, z), 1e-12)
    x, y, z = x / norm, y / norm, z / norm
    gx, gy, gz = position(g_normals, k, live)
    along = gx * x + gy * y + gz * z
    gx, gy, gz = (gx - along * x) / norm, (gy - along * y) / norm, (gz - along * z) / norm
    gx, gy, gz = back_to_world(px, py, pz, gx, gy, gz, CONTRACTED)  # the contraction's Jacobian is symmetric
    some = live & ((gx != 0.0) | (gy != 0.0) | (gz != 0.0))  # what is not met has no slope either
    bx, by, bz = position(gradient, count + k, some)
    _store(gradient, count + k, bx + gx, by + gy, bz + gz, some)


class Places(NamedTuple):
    """Where ∇sdf is asked for, frame of the grid: at (N, 3), epsilons (N,) of the differences, 0: this one is not asked. Of surfaces, where
    they mirror: points (H, 3), normalised frame, share (H,) of those that have a place; else (0, 3) and (0,)."""

    at: Tensor
    epsilons: Tensor
    points: Tensor
    share: Tensor


class Slopes(NamedTuple):
    """Of ∇sdf at ``Places``: gradient (N, 3) of the eikonal term; normals (H, 3) of mirrors."""

    gradient: Tensor
    normals: Tensor


def places(hits: Hits, rays: Rays, eikonal: Eikonal, extent: float, mirrors: bool) -> Places:
    """Points of all space, then surfaces; ``mirrors``: all of them, which have two rows for every ray. One launch."""
    count, rows, asked = len(eikonal.points), len(hits.share), min(len(eikonal.noise), len(rays.origins))
    total = count + (rows if mirrors else asked)
    new = lambda *shape: torch.empty(shape, device=hits.share.device)
    out = Places(new(total, 3), new(total), new(rows if mirrors else 0, 3), new(rows if mirrors else 0))
    with torch.cuda.device_of(out.at):
        places_kernel[(triton.cdiv(total, BLOCK),)](
            rays.origins, rays.directions, hits.distance, hits.depth, hits.share, eikonal.points, eikonal.noise, *out,
            eikonal.epsilon, eikonal.mirror_epsilon, len(rays.origins), rows, count, asked, mirrors, extent > 1.0, BLOCK,
        )  # fmt: skip
    return out


def eikonal_programs(where: Places) -> int:
    """How many sums ``eikonal_term`` makes."""
    return triton.cdiv(len(where.at), BLOCK)


def eikonal_term(slopes: Tensor, where: Places, eikonal: Eikonal, extent: float, loss: Tensor) -> Slopes:
    """The eikonal term's gradient, and normals; loss (``eikonal_programs``,) float64 is set to parts of the term. One launch."""
    count, mirrors = len(eikonal.points), len(where.points) > 0
    rows = len(slopes) - count
    out = Slopes(torch.empty_like(slopes), torch.empty_like(where.points))
    with torch.cuda.device_of(slopes):
        eikonal_kernel[(eikonal_programs(where),)](
            slopes, where.at, where.epsilons, where.points, loss, *out, eikonal.weight / max(asked_points(where, eikonal), 1),
            eikonal.shallow, count, rows, mirrors, extent > 1.0, BLOCK,
        )  # fmt: skip
    return out


def asked_points(where: Places, eikonal: Eikonal) -> int:
    """By how many the eikonal term is divided, see ``Eikonal``: its points and the rays that are asked, met or not."""
    more = len(where.points) // 2 if len(where.points) else len(eikonal.noise)
    return len(eikonal.points) + more


def normals_backward(slopes: Tensor, where: Places, g_normals: Tensor, gradient: Tensor, extent: float) -> None:
    """Add the gradient of the slopes behind the first that normals have; one launch."""
    rows = len(where.points)
    with torch.cuda.device_of(slopes):
        normals_backward_kernel[(triton.cdiv(rows, BLOCK),)](
            slopes, where.points, g_normals, gradient, len(slopes) - rows, rows, extent > 1.0, BLOCK
        )
