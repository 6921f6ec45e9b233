"""Lens models in torch: batched, differentiable, on any device.

Symbols: ``x, y`` image coordinates at unit focal length, *ideal* before the lens and *distorted* after it; r² = x² + y²; θ the angle
off the optical axis. A lens has one row of coefficients (..., C) for N points (..., N, 2); leading dimensions broadcast.

Brown-Conrady (Brown 1966, OpenCV's rational form), coefficients k1, k2, p1, p2, k3, k4, k5, k6:

    radial = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    x_d = x radial + 2 p1 x y + p2 (r² + 2 x²)
    y_d = y radial + p1 (r² + 2 y²) + 2 p2 x y

Kannala-Brandt (Kannala and Brandt 2006, OpenCV's fisheye), coefficients k1, k2, k3, k4:

    r_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸),  along the direction of (x, y)

Both are polynomials that turn back somewhere: behind this *fold* two rays share a point of the image and the model has no inverse.
The inverses start from the tabulated inverse of the rising branch, go on with Newton's method within a trust region, and are checked
by their residual. What no ray reaches is masked, never guessed: the usual few fixed-point iterations (OpenCV, kornia) answer with
finite numbers there, and far from the centre of strong lenses, too.

The gradients of the inverses are those of the implicit function theorem: one Newton step at the solution, taken under autograd.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor

_Point = tuple[Tensor, Tensor]  # x, y, (..., N) each

STEEPEST = math.radians(80.0)  # off axis: no Brown-Conrady lens sees farther
WIDEST = math.pi  # off axis: all that a fisheye could see
_TABLE = 1025
_ITERATIONS, _ALL = 30, 4  # of Newton's method; how many all points take: from the table most need three
_AT_REST = 1e-13  # the step of a point that has arrived
_TOLERANCE = 1e-10  # of the residual, at unit focal length
_STEP = 0.25  # the most that Newton's method moves at once: it stays on its branch
_ALONG = 64  # places on a ray's way from the axis where folds are looked for, if there may be any


def _radial(r2: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """Radial factor and its derivative with respect to r²; r² (..., N), k (..., 1, 8)."""
    k1, k2, _, _, k3, k4, k5, k6 = k.unbind(-1)
    top, d_top = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + 3 * r2 * k3)
    bottom, d_bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6)), k4 + r2 * (2 * k5 + 3 * r2 * k6)
    return top / bottom, (d_top * bottom - top * d_bottom) / bottom**2


def _distorted(x: Tensor, y: Tensor, k: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Distorted x and y of ideal ones (..., N), and their derivatives ∂x_d/∂x, ∂x_d/∂y = ∂y_d/∂x, ∂y_d/∂y."""
    p1, p2 = k[..., None, 2], k[..., None, 3]
    xx, yy = x * x, y * y
    r2 = xx + yy
    radial, slope = _radial(r2, k[..., None, :])
    twice, tangential = 2 * slope, 2 * (p1 * y + p2 * x)
    both = radial + tangential
    return (
        x * both + p2 * r2,
        y * both + p1 * r2,
        both + twice * xx + 4 * p2 * x,
        twice * x * y + 2 * (p1 * x + p2 * y),
        both + twice * yy + 4 * p1 * y,
    )


def distort(xy: Tensor, k: Tensor) -> Tensor:
    """Ideal (..., N, 2) → distorted (..., N, 2), Brown-Conrady with k (..., 8)."""
    return torch.stack(_distorted(xy[..., 0], xy[..., 1], k)[:2], -1)


def distort_jacobian(xy: Tensor, k: Tensor) -> Tensor:
    """∂ distorted[i] / ∂ ideal[j] of ``distort``: (..., N, 2, 2)."""
    _, _, along, across, down = _distorted(xy[..., 0], xy[..., 1], k)
    return torch.stack([torch.stack([along, across], -1), torch.stack([across, down], -1)], -2)


def _remembered(find: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Of lenses (..., 8); what is found of one alone is kept: each tile of a picture asks for its camera's."""

    @functools.lru_cache(maxsize=256)
    def of_one(k: tuple[float, ...], dtype: torch.dtype) -> Tensor:
        return find(torch.tensor(k, dtype=dtype))

    @functools.wraps(find)
    def found(k: Tensor) -> Tensor:
        return of_one(tuple(k.tolist()), k.dtype) if k.ndim == 1 and k.device.type == "cpu" else find(k.detach())

    return found


@_remembered
def fold_radius(k: Tensor) -> Tensor:
    """Ideal radius up to which the radial profile of Brown-Conrady lenses rises, (..., 8) → (...); at most tan 80°, ∞ of a pinhole."""

    def slope(angle: Tensor) -> Tensor:
        r2 = torch.tan(angle) ** 2
        radial, d = _radial(r2, k[..., None, :])
        return radial + 2 * r2 * d

    return torch.where((k != 0).any(-1), torch.tan(_first_fall(slope, STEEPEST, k)), torch.inf)


@_remembered
def _upright_radius(k: Tensor) -> Tensor:
    """Ideal radius up to which tangential terms fold in no direction, (..., 8) → (...).

    Their Jacobian's norm is below 8 r |p|. Where that is less than both slopes of the radial profile, the determinant stays positive.
    """
    p = torch.linalg.vector_norm(k[..., 2:4], dim=-1, keepdim=True)

    def room(angle: Tensor) -> Tensor:
        r = torch.tan(angle)
        radial, d = _radial(r * r, k[..., None, :])
        return torch.minimum(radial, radial + 2 * r * r * d) - 8 * r * p

    return torch.tan(_first_fall(room, STEEPEST, k))


def undistort(xy: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """Distorted → ideal, the inverse of ``distort`` on the branch that starts at the axis.

    Args:
        xy: (..., N, 2) distorted, float32 or float64; solved in float64. k: (..., 8).
    Returns:
        (..., N, 2) ideal, 0 where there is none, and (..., N) bool: whether there is one. Differentiable in ``xy`` and ``k``.
    """
    with torch.no_grad():
        target, lens = xy.double(), k.double()
        if not bool(lens.any()):
            point, valid = target.clone(), torch.isfinite(target).all(-1)
        else:
            point, valid = _undistorted(target, lens)
        point = torch.where(valid[..., None], point, 0.0).to(xy.dtype)
    if xy.requires_grad or k.requires_grad:
        along, across, down = _distorted(point[..., 0], point[..., 1], k.detach())[2:]
        rest = torch.where(valid[..., None], xy - distort(point, k), 0.0)
        onward = torch.stack(_solved(along, across, down, rest[..., 0], rest[..., 1]), -1)
        point = point + onward - onward.detach()
    return point, valid


def _undistorted(target: Tensor, lens: Tensor) -> tuple[Tensor, Tensor]:
    limit = fold_radius(lens)
    angles = torch.linspace(0.0, 1.0, _TABLE, dtype=torch.float64, device=lens.device) * torch.atan(limit).clamp(max=STEEPEST)[..., None]
    radii = torch.tan(angles)
    profile = radii * _radial(radii * radii, lens[..., None, :])[0]
    aim = target[..., 0], target[..., 1]
    distance = torch.hypot(*aim)
    start = torch.where(torch.isinf(limit)[..., None], distance, _interpolate(distance, profile, radii)) / distance.clamp(min=1e-300)
    point = aim[0] * start, aim[1] * start
    for _ in range(_ALL):
        point, length = _newton(point, aim, lens)
    # most have come to rest; of the others, those that are not far beyond the reach of the lens go on
    index = torch.nonzero((length > _AT_REST) & (distance < 1.5 * profile[..., -1:]), as_tuple=True)
    if len(index[0]):
        some, some_aim = ((x[index][:, None], y[index][:, None]) for x, y in (point, aim))
        lenses = _at(index, lens, distance)
        for _ in range(_ITERATIONS - _ALL):
            some, length = _newton(some, some_aim, lenses)
            if not bool((length > _AT_REST).any()):
                break
        for values, found in zip(point, some, strict=True):
            values[index] = found[:, 0]
    there, reached = _distorted(*point, lens), torch.hypot(*point)
    valid = (torch.hypot(aim[0] - there[0], aim[1] - there[1]) < _TOLERANCE) & (reached <= limit[..., None])
    if bool(lens[..., 2:4].any()):  # tangential terms may fold, too: the orientation holds all the way from the axis
        index = torch.nonzero(valid & (reached > _upright_radius(lens)[..., None]), as_tuple=True)
        if len(index[0]):
            x, y, lenses = point[0][index][:, None], point[1][index][:, None], _at(index, lens, distance)
            for share in torch.linspace(0.0, 1.0, _ALONG + 1)[1:].tolist():
                _, _, along, across, down = _distorted(share * x, share * y, lenses)
                valid[index] &= (along * down - across * across > 0)[:, 0]
    return torch.stack(point, -1), valid


def _at(index: tuple[Tensor, ...], lens: Tensor, points: Tensor) -> Tensor:
    """The lenses (I, 8) of some of the ``points`` (..., N)."""
    return lens[..., None, :].expand(*points.shape, lens.shape[-1])[index]


def _newton(point: _Point, aim: _Point, lens: Tensor) -> tuple[_Point, Tensor]:
    """The next point and how far it was, (..., N)."""
    x, y, along, across, down = _distorted(*point, lens)
    dx, dy = _solved(along, across, down, aim[0] - x, aim[1] - y)
    length = torch.hypot(dx, dy)
    part = _STEP / length.clamp(min=_STEP)
    return (point[0] + part * dx, point[1] + part * dy), length


def _solved(a: Tensor, b: Tensor, d: Tensor, u: Tensor, v: Tensor) -> _Point:
    """x, y of a x + b y = u, b x + d y = v; 0 where there is no inverse: a residual tells."""
    determinant = a * d - b * b
    determinant = torch.where(determinant.abs() > 1e-6, determinant, torch.inf)
    return (d * u - b * v) / determinant, (a * v - b * u) / determinant


def fisheye_radius(angle: Tensor, k: Tensor) -> Tensor:
    """Angle off axis (..., N) [rad] → distance from the image's centre (..., N), Kannala-Brandt with k (..., 4)."""
    k1, k2, k3, k4 = k[..., None, :].unbind(-1)
    a2 = angle * angle
    return angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))


def fisheye_slope(angle: Tensor, k: Tensor) -> Tensor:
    """Derivative of ``fisheye_radius`` with respect to the angle."""
    k1, k2, k3, k4 = k[..., None, :].unbind(-1)
    a2 = angle * angle
    return 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))


def fisheye_fold(k: Tensor) -> Tensor:
    """Angle [rad] up to which ``fisheye_radius`` rises, (..., 4) → (...); at most π."""
    k = k.detach()
    return _first_fall(lambda angle: fisheye_slope(angle, k), WIDEST, k)


def fisheye_angle(radius: Tensor, k: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of ``fisheye_radius`` on its rising branch.

    Args:
        radius: (..., N) ≥ 0, at unit focal length. k: (..., 4).
    Returns:
        (..., N) angle [rad], 0 where there is none, and (..., N) bool: whether there is one. Differentiable in both arguments.
    """
    with torch.no_grad():
        target, lens = radius.double(), k.double()
        limit = fisheye_fold(lens)
        angles = torch.linspace(0.0, 1.0, _TABLE, dtype=torch.float64, device=k.device) * limit[..., None]
        angle = _interpolate(target, fisheye_radius(angles, lens), angles)
        for _ in range(_ITERATIONS):
            slope = fisheye_slope(angle, lens)
            step = (target - fisheye_radius(angle, lens)) / torch.where(slope > 1e-6, slope, torch.inf)
            angle = angle + step.clamp(-_STEP, _STEP)
            if not bool((step.abs() > 1e-14).any()):
                break
        valid = ((target - fisheye_radius(angle, lens)).abs() < _TOLERANCE) & (angle <= limit[..., None]) & (angle >= 0)
        angle = torch.where(valid, angle, 0.0).to(radius.dtype)
        slope = fisheye_slope(angle, k)
    if radius.requires_grad or k.requires_grad:
        onward = torch.where(valid, radius - fisheye_radius(angle, k), 0.0) / slope
        angle = angle + onward - onward.detach()
    return angle, valid


def _first_fall(slope: Callable[[Tensor], Tensor], most: float, k: Tensor) -> Tensor:
    """Where a profile's slope (of (..., M) angles) is first not positive, (...); ``most`` where it is up to there."""
    angles = torch.linspace(0.0, most, 4 * _TABLE, dtype=k.dtype, device=k.device).expand(*k.shape[:-1], 4 * _TABLE)
    falls = ~(slope(angles) > 0)
    if not bool(falls.any()):
        return torch.full(k.shape[:-1], most, dtype=k.dtype, device=k.device)
    first = falls.int().argmax(-1, keepdim=True)
    low, high = angles.gather(-1, (first - 1).clamp(min=0)), angles.gather(-1, first)
    for _ in range(60):
        middle = 0.5 * (low + high)
        rising = slope(middle) > 0
        low, high = torch.where(rising, middle, low), torch.where(rising, high, middle)
    return torch.where(falls.any(-1), low[..., 0], most)


def _interpolate(x: Tensor, at: Tensor, values: Tensor) -> Tensor:
    """Piecewise linear through (at, values), both (..., M) and rising, at x (..., N); constant beyond the ends."""
    at, values = (t.expand(*x.shape[:-1], t.shape[-1]).contiguous() for t in (at, values))
    upper = torch.searchsorted(at, x.contiguous()).clamp(1, at.shape[-1] - 1)
    x0, x1, y0, y1 = at.gather(-1, upper - 1), at.gather(-1, upper), values.gather(-1, upper - 1), values.gather(-1, upper)
    share = ((x - x0) / (x1 - x0).clamp(min=1e-300)).clamp(0.0, 1.0)
    return y0 + share * (y1 - y0)
