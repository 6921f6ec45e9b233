"""Hard cases of few digits: finite differences, half precision, slopes, angles."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import pytest
import torch
from torch.nn.functional import normalize, softplus

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.surface import Surface

Row = Callable[[str, str, str], None]


def _sphere(finest: int) -> Surface:
    torch.manual_seed(0)
    return Surface(HashGrid(2, 10, 4, finest), 4, (0.5, 1e9))


def _degrees(found: torch.Tensor, truth: torch.Tensor) -> float:
    angle = torch.atan2(torch.linalg.cross(found.double(), truth).norm(dim=1), (found.double() * truth).sum(1))
    return float(torch.rad2deg(angle).square().mean().sqrt())


@pytest.mark.parametrize("finest", [256, 1024])
def test_finite_differences_as_small_as_a_cell(row: Row, finest: int) -> None:
    """Distances near 0.3, rounded to half precision as a mixed-precision network gives them."""
    surface = _sphere(finest)
    outward = normalize(torch.randn(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=1)
    points, epsilon = (0.8 * outward).float(), surface.grid.cell(2)
    errors = {}
    for dtype in (torch.float16, torch.bfloat16):
        taps = torch.tensor([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])
        shifted = (points[:, None] + taps * epsilon / 3**0.5).reshape(-1, 3)
        values = kernels.reference.surface_value(shifted, *surface.at(2)).detach().to(dtype).float().reshape(-1, 4)
        errors[dtype] = _degrees(values @ taps, outward)
    gradient = surface.gradient(points, epsilon, 2).detach()
    ours, noise = _degrees(gradient, outward), float((gradient.norm(dim=1) - 1).square().mean())
    # four taps see the curvature 1 / r of the sphere: an error of the first order in the cell
    assert ours < math.degrees(epsilon / (3**0.5 * 0.8)) and noise < 1e-4
    assert errors[torch.bfloat16] > 5 * ours and errors[torch.bfloat16] > errors[torch.float16] > ours
    row(
        f"normals by differences over a cell of {epsilon:.2g}",
        f"float16 {errors[torch.float16]:.2g}°, bfloat16 {errors[torch.bfloat16]:.2g}°",
        f"{ours:.1g}°, eikonal error {noise:.0e}",
    )


def test_half_precision_overflows_where_ours_does_not(row: Row) -> None:
    """A hidden layer whose sums exceed 65504 for a while."""
    surface = _sphere(64)
    with torch.no_grad():
        surface.hidden.mul_(1e5)
        surface.output_weight.normal_(0, 1e-6)
    points = torch.rand(500, 3) * 2 - 1
    half = copy.deepcopy(surface).half()
    usual = torch.relu(torch.cat([points, torch.ones(500, 1), surface.grid(points, 2)], 1).half() @ half.hidden.T)
    ours = surface(points, 2)
    ours.sum().backward()
    assert usual.isinf().any()
    assert torch.isfinite(ours).all() and all(torch.isfinite(p.grad).all() for p in surface.parameters())
    row(
        "a hidden layer beyond 65504",
        f"float16: {float(usual.isinf().any(1).float().mean()):.0%} of the points infinite",
        "float32: finite, with its gradients",
    )


def test_sharpness_beyond_the_range_of_exp(row: Row) -> None:
    """exp(-s f) of the usual backward pass overflows at s |f| = 88."""
    sdf = torch.tensor([0.2, -0.2, -0.3], requires_grad=True)
    usual = []
    for s in (64.0, 1e3, 1e6):
        f = sdf.detach()
        usual.append(bool(torch.isinf(torch.exp(-s * f)).any()))
        (gradient,) = torch.autograd.grad(kernels.section_weights(sdf, s, torch.tensor([0, 3]))[0].sum(), sdf)
        assert torch.isfinite(gradient).all()
    assert usual == [False, True, True]
    row("gradient of opacity at s |f| > 88", "exp(-s f): infinite", "softplus: finite up to s = 1e6")


def test_slopes_that_are_not_one(row: Row) -> None:
    """Early in a fit |∇f| may be anything; the usual opacity multiplies by it, ours looks at values alone."""
    s, step = 64.0, 0.02
    worst = 0.0
    for slope in (1e-3, 1.0, 1e3, 1e6):
        f = slope * torch.tensor([0.5 * step, -0.5 * step], dtype=torch.float64)
        ours = float(kernels.reference.section_weights(f, s, torch.tensor([0, 2]))[0].sum())
        exact = -math.expm1(-float(softplus(-s * f[1]) - softplus(-s * f[0]))) if s * slope * step < 600 else 1.0
        worst = max(worst, abs(ours - exact))
    assert worst < 1e-9
    # NeuS: estimates of the ends from the middle and the raw gradient, at a point 0.05 before the surface
    middle, slope = torch.tensor(0.05), 1e3
    ends = middle + torch.tensor([0.5, -0.5]) * slope * step
    p, c = torch.sigmoid(s * ends[0]), torch.sigmoid(s * ends[1])
    usual = float((p - c + 1e-5) / (p + 1e-5))
    assert usual > 0.99
    row(
        "|∇f| = 1000, 0.05 before a surface",
        f"ends from the raw gradient: opacity {usual:.2f} of empty space",
        f"values at the ends: exact to {max(worst, 1e-16):.0e}",
    )


@pytest.mark.parametrize("angle", [1e-6, 1e-4])
def test_small_angles(row: Row, angle: float) -> None:
    a = torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True)
    b = torch.tensor([[math.sin(angle), 0.0, math.cos(angle)]])
    usual = torch.acos((a * b).sum(1).clamp(-1 + 1e-6, 1 - 1e-6))
    (none,) = torch.autograd.grad(usual.sum(), a)
    ours = torch.atan2(torch.linalg.cross(a, b).norm(dim=1), (a * b).sum(1))
    (some,) = torch.autograd.grad(ours.sum(), a)
    assert abs(float(usual.detach()) - angle) > 1e-3 and not none.any()
    assert float(ours.detach()) == pytest.approx(angle, rel=1e-3) and float(some[0, 0]) == pytest.approx(-1.0, rel=1e-3)
    row(
        f"an angle of {angle:g} rad",
        f"acos, clamped: {float(usual.detach()):.1e}, no gradient",
        f"atan2: {float(ours.detach()):.1e}, gradient {float(some[0, 0]):.1f}",
    )
