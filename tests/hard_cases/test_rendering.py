"""Numerical hard cases of volume rendering an SDF: what the usual formula does, and the bound that ours keeps."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize, softplus
from usual import nerfacc_keeps, neus_weights

from mmsynth.field import kernels
from mmsynth.field.design import Design
from mmsynth.field.encoding import HashGrid
from mmsynth.field.field import Field
from mmsynth.field.kernels import OUTSIDE, SHELL, Hits, Rays, Sampling, reference
from mmsynth.field.kernels.constants import MAX_SAMPLES_PER_RAY
from mmsynth.field.kernels.cpu import marching
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.rendering import ball_interval, trace
from mmsynth.field.surface import Surface
from mmsynth.scene.scene import Region, Sensor
from mmsynth.sensors.camera import Camera

Row = Callable[[str, str, str], None]


def ours(sdf: torch.Tensor, s: float) -> torch.Tensor:
    return kernels.section_weights(sdf, s, torch.tensor([0, len(sdf)]))[0]


def _parts(radius: float = 0.5, extent: float = 1.0, levels: int = 2) -> tuple[Surface, HashGrid, Occupancy]:
    """A sphere, whose signed distance is exact but for 1e-4."""
    torch.manual_seed(0)
    surface = Surface(HashGrid(levels, 8, 4, 8, extent), 4, (radius, 1.9 if extent > 1 else 1e9))
    return surface, HashGrid(levels, 8, 4, 8, extent), Occupancy(16, extent)


SAMPLING = Sampling(sharpness=400.0, step=0.005, active_surface=2, active_radiance=2)
WAYS = ("fused", "by parts", "float64")


def _trace(
    way: str,
    parts: tuple[Surface, HashGrid, Occupancy],
    origins: torch.Tensor,
    directions: torch.Tensor,
    sampling: Sampling = SAMPLING,
    jitter: float = 0.5,
    interval: tuple[torch.Tensor, torch.Tensor] | None = None,
) -> Hits:
    """Rays through the unit ball (or all of space), by each of the ways there are."""
    surface, appearance, occupancy = parts
    if way == "float64":
        surface, appearance = copy.deepcopy(surface).double(), copy.deepcopy(appearance).double()
        origins, directions = origins.double(), directions.double()
    shift = torch.full_like(origins[:, 0], jitter)
    if interval is None:
        interval = ball_interval(origins.detach(), directions.detach())
        if surface.grid.extent > 1:
            interval = torch.zeros_like(shift), torch.full_like(shift, 1e3)
    rays = Rays(origins, directions, *(x.to(origins) for x in interval), shift)
    operations = kernels.cpu if way == "fused" else reference
    look = appearance.at(sampling.active_radiance)
    return operations.trace(*surface.at(sampling.active_surface), look, occupancy.states, rays, sampling)


def _towards(count: int, miss: float, distance: float = 3.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays from all sides that pass the centre at distance ``miss``."""
    generator = torch.Generator().manual_seed(1)
    directions = normalize(torch.randn(count, 3, generator=generator), dim=1)
    aside = normalize(torch.linalg.cross(directions, torch.randn(count, 3, generator=generator)), dim=1)
    return miss * aside - distance * directions, directions


# --- empty space, deep inside, any sharpness


def test_empty_space_haze(row: Row) -> None:
    sdf = torch.full((1025,), 0.3)
    usual = neus_weights(sdf, 512.0).sum()
    assert usual > 0.009
    assert ours(sdf, 512.0).sum() == 0.0
    row("1024 samples of empty space, s = 512", f"NeuS: opacity {usual:.3f}", "0, exactly")


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("s", [1.0, 50.0, 1e3, 1e6])
def test_empty_space_has_exactly_no_opacity(way: str, s: float) -> None:
    parts, sampling = _parts(), Sampling(s, min(0.1, 2 / s), 2, 2)
    for value in (1e-6, 0.3, 1.0):
        assert not ours(torch.full((1000,), value), s).any()
    # rays that leave the surface behind them
    directions = normalize(torch.randn(100, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    origins = (0.55 * directions).requires_grad_()
    hits = _trace(way, parts, origins, directions, sampling)
    assert hits.samples > 100 and not hits.opacity.any() and hits.depth.isnan().all() and not hits.features.any()
    hits.opacity.sum().backward()
    assert not origins.grad.any()
    # rays that pass it, far enough for this sharpness
    if s >= 1e3:
        hits = _trace(way, parts, *_towards(100, 0.6), sampling)
        assert hits.samples > 100 and not (hits.opacity > (0 if way == "fused" else 1e-30)).any()


def test_deep_inside(row: Row) -> None:
    """Falling through the inside of an object at f = -0.05: the exact opacity of a section is 0.641."""
    sdf = torch.tensor([-0.05, -0.052])
    exact = 1 - np.exp(-512 * 0.002)
    opacity = float(-torch.expm1(-reference.section_depth(sdf[:1], sdf[1:], 512.0, torch.tensor([False]))))
    assert neus_weights(sdf, 512.0)[0] > 0.99
    assert opacity == pytest.approx(exact, abs=1e-5)
    row(
        "a section deep inside, f = -0.05, s = 512",
        f"NeuS: opacity {neus_weights(sdf, 512.0)[0]:.3f}",
        f"{opacity:.3f}; exact {exact:.3f}",
    )


@pytest.mark.parametrize("pair", [(-0.05, -0.052), (-0.052, -0.05), (-0.05, -0.05), (-0.05, 0.01)])
def test_a_ray_that_enters_the_region_inside_of_something_solid(row: Row, pair: tuple[float, float]) -> None:
    """What its opacity is asked to lose pulls the distance up, until nothing is there."""
    sdf, s = torch.tensor(pair, dtype=torch.float64, requires_grad=True), 20.0
    weights, crossing = kernels.section_weights(sdf, s, torch.tensor([0, 2]))
    assert float(weights[0].detach()) == pytest.approx(1.0 - 2.0 / (1.0 + np.exp(-s * min(pair))), abs=1e-12)
    assert crossing[0] == 0.0
    (gradient,) = torch.autograd.grad(-torch.log1p(-weights[0]), sdf)
    assert gradient.sum() < -0.5 * s and not (gradient > 0).any()
    section = reference.section_depth(sdf[:1], sdf[1:], s, torch.tensor([False]))
    usual = torch.autograd.grad(section.sum(), sdf)[0].sum()
    row(
        f"slope of optical depth over a shift of both ends, a ray beginning inside, s = 20, f = {pair[0]}, {pair[1]}",
        f"of the difference of both ends: {float(usual):+.2f}",
        f"{float(gradient.sum()):+.2f}",
    )


@pytest.mark.parametrize("way", WAYS)
def test_rays_that_begin_behind_a_surface_meet_it_where_they_begin(way: str) -> None:
    parts = _parts()
    origins, directions = _towards(50, 0.1)
    inside = torch.full((50,), 2.9), torch.full((50,), 3.3)
    hits = _trace(way, parts, origins, directions, interval=inside, jitter=0.0)
    assert (hits.opacity > 0.999).all()
    torch.testing.assert_close(hits.depth.float(), inside[0], atol=1e-6, rtol=0)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("s", [4.0, 20.0])
def test_a_camera_deep_inside_sees_what_the_formula_says(way: str, s: float) -> None:
    """From the surface, where all rays come from, to the centre at -0.5: log Φ falls by almost s · 0.5."""
    step = 0.02
    origins, directions = torch.tensor([[0.0, 0.0, -0.45]]), torch.tensor([[0.0, 0.0, 1.0]])
    hits = _trace(way, _parts(), origins, directions, Sampling(s, step, 2, 2, max_optical_depth=100.0), jitter=0.0)
    tau = softplus(torch.tensor(s * 0.5)) - np.log(2.0)
    # the sample next to the centre is half a step from it at most
    assert 1 - np.exp(-float(tau) + s * step / 2) - 1e-3 <= float(hits.opacity.detach()) <= 1 - np.exp(-float(tau)) + 1e-3


@pytest.mark.parametrize("s", [1.0, 1e3, 1e6])
def test_any_sharpness_is_finite_and_sums_to_at_most_one(row: Row, s: float) -> None:
    sdf = torch.linspace(1.0, -1.0, 777).requires_grad_()
    weights = ours(sdf, s)
    weights.square().sum().backward()
    assert torch.isfinite(weights).all() and torch.isfinite(sdf.grad).all()
    assert float(weights.detach().double().sum()) <= 1 + 1e-6
    expected = 1 - (1 / (1 + np.exp(s))) / (1 / (1 + np.exp(-s))) if s < 100 else 1.0
    assert float(weights.detach().sum()) == pytest.approx(expected, abs=1e-5)
    usual = neus_weights(sdf.detach(), s).sum()
    assert abs(float(usual) - expected) > 3e-5
    row(
        f"through a surface, s = {s:g}",
        f"NeuS: opacity {usual:.5f}",
        f"{float(weights.detach().sum()):.5f}; exact {expected:.5f}, gradients finite",
    )


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("classified", [False, True])
@pytest.mark.parametrize("s", [1.0, 1e3, 1e6])
def test_any_sharpness_gives_finite_rays_and_gradients(way: str, classified: bool, s: float) -> None:
    parts, sampling = _parts(), Sampling(s, min(0.1, 2 / s), 2, 2)
    with torch.no_grad():
        parts[0].output_weight.normal_(0, 0.02)
    if classified:
        parts[2].update(lambda x: parts[0](x, 2), s)
    parts[0].requires_grad_(way != "float64")  # there a copy is asked
    sets = [_towards(40, miss) for miss in (0.0, 0.3, 0.49, 0.499, 0.5, 0.501, 0.9, 1.1)]
    origins, directions = (torch.cat(x).requires_grad_() for x in zip(*sets, strict=True))
    hits = _trace(way, parts, origins, directions, sampling)
    assert torch.isfinite(hits.opacity).all() and torch.isfinite(hits.features).all()
    assert float(hits.opacity.detach().min()) >= 0 and float(hits.opacity.detach().max()) <= 1 + 1e-5
    if s >= 1e3:
        assert (hits.opacity[:80] > 0.999).all() and not hits.opacity[-40:].any()
    (hits.opacity.square().sum() + hits.features.square().sum()).backward()
    found = [origins.grad, directions.grad, *(p.grad for p in parts[0].parameters() if p.requires_grad)]
    assert all(torch.isfinite(g).all() for g in found) and origins.grad.any()


def test_opaque_section_does_not_divide_by_zero(row: Row) -> None:
    """α = 1 exactly, then more samples: cumprod needs an epsilon, exp(-Σ) does not."""
    sdf = torch.tensor([1.0, -1.0, -2.0, 1.0, -1.0]).requires_grad_()
    weights = ours(sdf, 1e4)
    weights.sum().backward()
    assert weights.tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]
    assert torch.isfinite(sdf.grad).all()
    left = neus_weights(sdf.detach(), 1e4)[1:].sum()
    alpha = torch.tensor([1.0, 1.0, 0.0, 1.0], requires_grad=True)
    (alpha * torch.exp(torch.cat([torch.zeros(1), torch.log(1 - alpha).cumsum(0)[:-1]]))).sum().backward()
    assert left > 0 and alpha.grad.isnan().any()
    row(
        "samples behind an opaque section",
        f"cumprod with 1e-7: {float(left):.0e} of what is behind; exp(Σ log(1 - α)): gradient NaN for {int(alpha.grad.isnan().sum())} of 4",
        "exp of a sum: weights 1, 0, 0, 0",
    )


@pytest.mark.parametrize("way", WAYS)
def test_a_ray_that_was_ended_is_opaque(way: str) -> None:
    """At an optical depth of 3 it is e⁻³ = 5% transparent: what is left is given to the surface that ended it."""
    parts = _parts()
    with torch.no_grad():
        parts[1].table.fill_(0.7)
    rays = _towards(200, 0.2)
    ended = _trace(way, parts, *rays)
    whole = _trace(way, parts, *rays, Sampling(400.0, 0.005, 2, 2, max_optical_depth=30.0))
    assert ended.samples < whole.samples
    torch.testing.assert_close(ended.opacity, torch.ones_like(ended.opacity), atol=1e-6, rtol=0)
    torch.testing.assert_close(ended.features, torch.full_like(ended.features, 0.7), atol=1e-6, rtol=0)
    torch.testing.assert_close(ended.depth, whole.depth, atol=1e-6, rtol=0)
    # a ray that was not ended keeps what it did not meet
    soft = _trace(way, parts, *_towards(50, 0.499), Sampling(20.0, 0.02, 2, 2))
    expected = 1 - torch.sigmoid(torch.tensor(20 * -0.001)) / torch.sigmoid(torch.tensor(20 * 0.5))
    torch.testing.assert_close(soft.opacity, expected.expand(50).to(soft.opacity), atol=0.01, rtol=0)


# --- where rays are


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_depth_of_a_sphere_is_exact(row: Row, way: str, extent: float) -> None:
    """The surface is where the section crosses it: no bias by half a step."""
    directions = normalize(torch.tensor([[0.0, 0.0, 1.0], [0.05, 0.1, 1.0], [-0.1, 0.08, 1.0]]), dim=1)
    origins = torch.tensor([[0.0, 0.0, -3.0]]).expand(3, 3)
    b = (origins * directions).sum(1)
    exact = -b - torch.sqrt(b * b - 9.0 + 0.25)
    depth = _trace(way, _parts(extent=extent), origins, directions).depth
    torch.testing.assert_close(depth, exact.to(depth), atol=2e-4, rtol=0)
    # MultimodalStudio: opacity around each sample, depth at the middle of the interval that begins there
    t = exact[:, None] + SAMPLING.step * (torch.arange(-32, 32) + 0.3)
    x = origins[:, None] + t[..., None] * directions[:, None]
    half = 0.5 * SAMPLING.step * (normalize(x, dim=-1) * directions[:, None]).sum(-1).clamp(max=0)
    f, s = x.norm(dim=-1) - 0.5, SAMPLING.sharpness
    p, c = torch.sigmoid(s * (f - half)), torch.sigmoid(s * (f + half))
    alpha = ((p - c + 1e-5) / (p + 1e-5)).clamp(0, 1)
    weights = alpha * torch.cumprod(torch.cat([torch.ones(3, 1), 1 - alpha + 1e-7], 1), 1)[:, :-1]
    usual = float(((weights * (t + 0.5 * SAMPLING.step)).sum(1) / weights.sum(1) - exact).mean())
    assert usual > 5 * float((depth - exact).abs().max())
    if extent == 1.0:
        row(
            f"depth of a ball, s = {s:.0f}, a step of {SAMPLING.step:g}, {way}",
            f"MultimodalStudio, at the middle of intervals: {usual:+.4f}, {usual / SAMPLING.step:.2f} steps",
            f"off by up to {float((depth - exact).abs().max()):.0e}",
        )


@pytest.mark.parametrize("way", WAYS)
def test_depth_of_the_horizon_is_exact(way: str) -> None:
    """A sphere of contracted radius 1.9 is one of radius 10 around a camera anywhere."""
    directions = normalize(torch.randn(60, 3, generator=torch.Generator().manual_seed(3)), dim=1)
    origins = torch.tensor([[0.0, 0.7, 0.3], [0.0, -4.0, 2.0], [-0.5, -0.6, 0.0]]).repeat(20, 1)
    b, c = (origins * directions).sum(1), (origins * origins).sum(1)
    free = (b > 0) | (c - b * b > 0.3)  # of the inner sphere
    exact = -b + torch.sqrt(b * b - c + 100.0)
    depth = _trace(way, _parts(extent=2.0), origins, directions).depth
    assert free.sum() > 30
    torch.testing.assert_close(depth[free], exact[free].to(depth), rtol=5e-3, atol=0)  # 1e-4 of contracted space is 1% there


@pytest.mark.parametrize("way", WAYS)
def test_camera_inside_the_region_and_zero_samples(row: Row, way: str) -> None:
    origins = torch.tensor([[0.0, 0.0, -0.8], [0.0, 0.0, -0.8], [0.0, 0.0, 5.0], [3.0, 0.0, 0.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    depth = _trace(way, _parts(), origins, directions).depth
    assert float(depth[0]) == pytest.approx(0.3, abs=1e-3)
    assert torch.isnan(depth[1:]).all()
    parts = _parts()
    nothing = _trace(way, parts, origins[2:], directions[2:])  # not one sample in the whole batch
    assert int(nothing.samples) == 0 and torch.isnan(nothing.depth).all() and not nothing.opacity.any() and not nothing.features.any()
    (nothing.opacity.sum() + nothing.features.sum()).backward()
    assert all(p.grad is None or not p.grad.any() for m in parts for p in m.parameters())
    with pytest.raises(RuntimeError, match="min"):
        nothing.depth.clip(torch.empty(0).min(), torch.empty(0).max())
    row(
        f"a camera inside the region; a batch without a sample, {way}",
        "MultimodalStudio clips depth to the nearest sample's: RuntimeError, min of none",
        "its depth, to 1e-3; nothing, and no gradient",
    )


@pytest.mark.parametrize("way", WAYS)
def test_rays_of_no_sample_and_of_one_between_others(way: str) -> None:
    """A section needs two ends: a single sample shows nothing and gets no gradient."""
    origins, directions = _towards(9, 0.1)
    origins.requires_grad_()
    near, far = ball_interval(origins.detach(), directions)
    far[1::3] = near[1::3]
    near[2::3] += 1.45
    far[2::3] = near[2::3] + 0.004  # less than a step, right before the surface
    parts = _parts()
    hits = _trace(way, parts, origins, directions, interval=(near, far))
    alone = _trace(way, parts, origins[::3], directions[::3], interval=(near[::3], far[::3]))
    assert int(hits.samples) == int(alone.samples) + 3
    torch.testing.assert_close(hits.opacity[::3], alone.opacity, atol=1e-6, rtol=0)
    for k in (1, 2):
        assert not hits.opacity[k::3].any() and not hits.features[k::3].any() and hits.depth[k::3].isnan().all()
    (hits.opacity.sum() + hits.features.square().sum()).backward()
    assert torch.isfinite(origins.grad).all() and not origins.grad[1::3].any() and not origins.grad[2::3].any()


@pytest.mark.parametrize("way", WAYS)
def test_rays_in_a_face_of_a_grid_cell_are_finite(row: Row, way: str) -> None:
    """Axis-parallel rays exactly in cell faces: the slab test's 0 / 0."""
    surface, appearance, _ = _parts()
    occupancy = Occupancy(8)
    occupancy.states[:, :, 4:] = OUTSIDE
    origins = torch.tensor([[-2.0, 0.25, -0.25], [-2.0, 0.0, 0.0], [-2.0, -0.5, 0.25]])
    directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3)
    hits = _trace(way, (surface, appearance, occupancy), origins, directions)
    assert float(hits.depth[0]) == pytest.approx(2 - np.sqrt(0.25 - 0.125), abs=1e-3)
    assert not hits.opacity[1:].any() and hits.depth[1:].isnan().all()
    slab = (torch.tensor([-0.25, 0.25]) - origins[:, 1:2]) / directions[:, 1:2]
    assert slab.isnan().any()
    row(
        f"rays in the face of a cell, {way}",
        f"the slab test: 0 / 0 = NaN for {int(slab.isnan().any(1).sum())} of 3",
        "the depth of the ball, to 1e-3",
    )


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_rays_along_axes_and_diagonals_of_cells_see_what_their_neighbours_see(way: str, extent: float) -> None:
    parts = _parts(extent=extent)
    parts[2].update(lambda x: parts[0](x, 2), 400.0)
    faces = torch.cartesian_prod(*[torch.tensor([-0.25, 0.0, 0.125])] * 3)
    lines = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)
    lines = normalize(lines[lines.norm(dim=1) > 0], dim=1)
    directions = lines.repeat_interleave(len(faces), 0)
    origins = faces.repeat(len(lines), 1) - 2.0 * directions
    hits = _trace(way, parts, origins, directions)
    aside = _trace(way, parts, origins + 1e-4 * torch.tensor([[0.3, -0.5, 0.8]]), directions)
    assert torch.isfinite(hits.opacity).all() and (hits.opacity > 0.99).all() and hits.depth.isfinite().all()
    torch.testing.assert_close(hits.depth, aside.depth, atol=2e-3, rtol=0)


def test_ball_interval_of_tangent_and_receding_rays(row: Row) -> None:
    origins = torch.tensor([[-2.0, 1.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-1e4, 0.5, 0.0]])
    directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(4, 3)
    near, far = ball_interval(origins, directions)
    assert far[0] == pytest.approx(float(near[0]), abs=1e-3) and far[1] == near[1]
    assert near[2] == 0 and far[2] == 1
    # a camera 10,000 radii away: |o|² - (o·d)² in float32 would lose the chord entirely
    assert float(far[3] - near[3]) == pytest.approx(2 * np.sqrt(0.75), abs=5e-3)
    o, d = origins[3], directions[3]
    usual = 2 * torch.sqrt(((o @ d) ** 2 - o @ o + 1).clamp(min=0))
    assert abs(float(usual) - np.sqrt(3)) > 0.1
    row(
        "the chord of a ball 10,000 radii away, float32",
        f"(o·d)² - |o|² + 1: {float(usual):.2f}",
        f"{float(far[3] - near[3]):.3f}; exact 1.732",
    )


def _roi(origins: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """MultimodalStudio's sphere: near and far = -o·d ∓ √max(Δ, 0.01), 0.01 at least, and whether it counts as met: Δ > 0.01."""
    along = (origins * directions).sum(1)
    delta = along**2 - (origins * origins).sum(1) + 1
    half = delta.clamp(min=0.01).sqrt()
    return (-along - half).clamp(min=0.01), (-along + half).clamp(min=0.01), delta > 0.01


def test_rays_that_graze_the_region_and_rays_that_leave_it(row: Row) -> None:
    """A chord of 0.19 radii is inside the region; what lies behind a camera is not."""
    origins, directions = _towards(100, 0.9955)
    near, far = ball_interval(origins, directions)
    met = _roi(origins, directions)[2]
    chord = 2 * np.sqrt(1 - 0.9955**2)
    torch.testing.assert_close(far - near, torch.full((100,), chord), atol=1e-3, rtol=0)
    assert not met.any()
    row(
        f"rays with {chord:.2f} radii of the region before them",
        f"MultimodalStudio: background for {1 - float(met.float().mean()):.0%}",
        f"{float((far - near).mean()):.2f} radii are seen",
    )
    origins, directions = _towards(100, 0.3)
    near, far = ball_interval(origins, -directions)
    theirs = _roi(origins, -directions)
    assert torch.equal(near, far) and theirs[2].all() and (theirs[0] == theirs[1]).all()
    row(
        "rays that leave the region behind them",
        f"MultimodalStudio: foreground for {float(theirs[2].float().mean()):.0%}, near = far = {float(theirs[1].max()):.2f}",
        "no interval",
    )


@pytest.mark.parametrize("way", ["fused", "by parts"])
@pytest.mark.parametrize(("distance", "step"), [(1e2, 1e-3), (1e4, 1e-3), (6.0, 2e-6), (1e3, 2e-6)])
def test_steps_smaller_than_float32_resolves_so_far_away_come_to_an_end(way: str, distance: float, step: float) -> None:
    """Ten thousand radii away float32 counts in thousandths: a ray that skips a free cell must not stand still in it."""
    parts = _parts()
    parts[2].update(lambda x: parts[0](x, 2), 2 / step)
    hits = _trace(way, parts, *_towards(200, 0.8, distance), Sampling(2 / step, step, 2, 2))
    assert not hits.opacity.any()
    hits = _trace(way, parts, *_towards(200, 0.1, distance), Sampling(2 / step, step, 2, 2))
    assert torch.isfinite(hits.opacity).all() and hits.samples <= 200 * MAX_SAMPLES_PER_RAY
    if step == 1e-3:
        exact = torch.full((200,), distance - np.sqrt(0.24))
        torch.testing.assert_close(hits.depth, exact, rtol=2.5e-7, atol=2e-3)


@pytest.mark.parametrize("way", WAYS)
def test_a_grazing_ray(way: str) -> None:
    """Just inside, it meets the surface; just outside, the soft part of it; the closed form of the least distance in between."""
    opacity = []
    for miss in (0.45, 0.49, 0.498, 0.5, 0.502, 0.51, 0.55):
        origins, directions = _towards(60, miss)
        origins.requires_grad_()
        hits = _trace(way, _parts(), origins, directions)
        hits.opacity.sum().backward()
        assert torch.isfinite(origins.grad).all()
        found = hits.opacity.detach()
        tau = softplus(torch.tensor(-400 * (miss - 0.5)).double())
        exact = 1.0 if tau > SAMPLING.max_optical_depth else float(1 - torch.exp(-tau))
        torch.testing.assert_close(found, torch.full_like(found, exact), atol=0.03, rtol=0)
        opacity.append(float(found.mean()))
    assert opacity == sorted(opacity, reverse=True) and opacity[0] > 0.999 and opacity[-1] < 1e-6


def _sheet(half: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """|z| - half: a sheet of which the distance is true."""
    return lambda x: x[:, 2].abs() - half


def _trace_sheet(half: float, occupancy: Occupancy, rays: Rays) -> Hits:
    samples = reference.march(_sheet(half), rays, occupancy.states, 1.0, SAMPLING)
    return reference.composite(_sheet(half), HashGrid(1, 8, 4, 4).double().at(2), rays, samples, SAMPLING)


def _bounds(half: float) -> tuple[float, float]:
    """Opacity of a sheet or ball of half a thickness: a sample is within half a step of the middle."""
    worst, exact = (float(softplus(torch.tensor(-SAMPLING.sharpness * f))) for f in (SAMPLING.step / 2 - half, -half))
    upper = 1.0 if exact > SAMPLING.max_optical_depth else 1 - np.exp(-exact)
    return 1 - np.exp(-worst), upper


@pytest.mark.parametrize("steps", [0.2, 0.5, 1.0, 3.0])
def test_a_thin_sheet_is_not_stepped_over(row: Row, steps: float) -> None:
    """Thinner than a step and far from where the ray begins: the distance says where to look."""
    half = steps * SAMPLING.step / 2
    tilted = normalize(torch.tensor([[0.0, 0.0, 1.0], [0.3, 0.1, 1.0], [0.0, -0.8, -1.0]]), dim=1).repeat(60, 1).double()
    jitter = torch.linspace(0, 0.99, 180).double()
    near, far = torch.full((180,), 0.0).double(), torch.full((180,), 1.8).double()
    occupancy = Occupancy(16)
    hits = _trace_sheet(half, occupancy, Rays(-0.9 * tilted, tilted, near, far, jitter))
    low, high = _bounds(half)
    assert float(hits.opacity.min()) >= low - 1e-6 and float(hits.opacity.max()) <= high + 1e-6
    occupancy.update(_sheet(half), SAMPLING.sharpness)
    fewer = _trace_sheet(half, occupancy, Rays(-0.9 * tilted, tilted, near, far, jitter))
    assert fewer.samples < hits.samples and float(fewer.opacity.min()) >= low - 1e-6
    at = -0.9 * tilted[:, 2:] + tilted[:, 2:] * (torch.arange(64) + jitter[:, None]) / 64 * 1.8
    usual = float((at.abs() - half < 0).any(1).double().mean())
    assert usual < 0.7
    row(
        f"a sheet of {steps:g} steps' thickness",
        f"64 even samples: {usual:.0%} of the rays meet it",
        f"all rays, opacity from {float(hits.opacity.min()):.2f} on",
    )


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("steps", [0.2, 1.0, 3.0])
def test_a_small_ball_is_not_stepped_over(way: str, steps: float) -> None:
    half = steps * SAMPLING.step / 2
    low, high = _bounds(half)
    for jitter in (0.0, 0.3, 0.6, 0.9):
        found = _trace(way, _parts(half), *_towards(100, 0.0), jitter=jitter).opacity.detach()
        assert float(found.min()) >= low - 0.03 and float(found.max()) <= high + 0.03


def test_a_scene_far_from_the_origin_is_the_same_scene() -> None:
    """Everything is computed in the normalised frame: neither a large world nor a small one costs digits."""
    sensors, camera = {"mono": Sensor("mono", ("mono",), (None,))}, Camera(24, 18, 30.0, 30.0, 11.5, 8.5)
    design = Design(surface_levels=2, radiance_levels=2, surface_finest=8, radiance_finest=8, coarsest=4, occupancy=16)
    pose = np.eye(4)
    pose[:3, 3] = 0.1, 0.0, -2.0
    pictures = []
    for centre, radius in (((0.0, 0.0, 0.0), 1.0), ((1e6, -4e5, 3e4), 2.0), ((50.0, 0.0, 0.0), 1e-3)):
        torch.manual_seed(0)
        field = Field(design, sensors, {"mono": 0.5}, Region(centre, radius))
        field.sampling = SAMPLING
        moved = pose.copy()
        moved[:3, 3] = np.array(centre) + radius * pose[:3, 3]
        seen = field.render(camera, moved)
        pictures.append((seen.channels["mono"], seen.opacity, seen.depth_z / radius, seen.normal, field.sdf(moved[None, :3, 3]) / radius))
    assert np.isfinite(pictures[0][2]).sum() > 50
    for other in pictures[1:]:
        for a, b in zip(pictures[0], other, strict=True):
            np.testing.assert_allclose(b, a, atol=2e-5)


# --- not a number


@pytest.mark.parametrize("way", ["fused", "by parts"])
def test_not_a_number_is_not_swallowed(way: str) -> None:
    """A fit must see it, to skip the step."""
    parts = _parts()
    with torch.no_grad():
        parts[0].output_weight[-1] = torch.nan
    assert _trace(way, parts, *_towards(50, 0.3)).opacity.isnan().all()
    parts = _parts()
    (_trace(way, parts, *_towards(50, 0.3)).opacity * torch.where(torch.arange(50) == 7, torch.nan, 1.0)).sum().backward()
    assert parts[0].output_weight.grad.isnan().all()
    parts = _parts()
    with torch.no_grad():
        parts[1].table.fill_(torch.nan)
    hits = _trace(way, parts, *_towards(50, 0.3))
    assert hits.features.isnan().all() and torch.isfinite(hits.opacity).all()


@pytest.mark.parametrize("way", ["fused", "by parts"])
def test_not_a_number_stays_in_its_ray(way: str) -> None:
    origins, directions = _towards(50, 0.3)
    expected = _trace(way, _parts(), origins, directions)
    origins[7] = torch.nan
    hits = _trace(way, _parts(), origins, directions)
    others = torch.arange(50) != 7
    torch.testing.assert_close(hits.opacity[others], expected.opacity[others], atol=1e-6, rtol=0)
    torch.testing.assert_close(hits.features[others], expected.features[others], atol=1e-6, rtol=0)


# --- the occupancy grid


def test_an_empty_occupancy_grid_reopens(row: Row) -> None:
    occupancy = Occupancy(8)
    assert not occupancy.update(lambda x: torch.full((len(x),), 5.0), 100.0)
    assert (occupancy.states == SHELL).all()
    # all solid is as empty: nothing to see from anywhere
    assert not occupancy.update(lambda x: torch.full((len(x),), -5.0), 100.0)
    assert (occupancy.states == SHELL).all()
    # and what appears then is seen
    surface, appearance, _ = _parts()
    hits = _trace("fused", (surface, appearance, occupancy), *_towards(20, 0.1))
    assert (hits.opacity > 0.99).all()
    assert occupancy.update(lambda x: surface(x, 2), 100.0)
    # f = 5 everywhere: VolSDF's density is 0, and so is every cell's opacity
    none = nerfacc_keeps(50.0 * torch.exp(torch.full((8**3,), -5.0 * 100)))
    assert not none.any()
    row(
        "an occupancy grid in which nothing is left",
        f"nerfacc, above the mean of no positive cell, NaN: {int(none.sum())} of {len(none)} cells kept",
        "opened again, counted, and what appears is seen",
    )


def test_a_pruned_cell_comes_back() -> None:
    """A surface that moves into cells that were certified is there when each has had its turn, and no later."""
    moved, anew = Occupancy(48), Occupancy(48)
    moved.update(lambda x: x[:, 0] + 0.9, 500.0)
    assert (moved.states[45] >= OUTSIDE).all() and moved.turns > 1
    for turn in range(40, 40 + moved.turns):
        moved.update(lambda x: x[:, 0] - 0.9, 500.0, turn)
    anew.update(lambda x: x[:, 0] - 0.9, 500.0)
    assert torch.equal(moved.states, anew.states) and (moved.states[45] == SHELL).any()


@pytest.mark.parametrize("grid", [8, 16, 48, 64, 85, 96, 102, 255, 256])
def test_the_cells_of_a_plane_do_not_wait_for_one_turn(grid: int, row: Row) -> None:
    """A table lies in a plane of the grid. Where all of its cells had their turn together, as every 16th of 96³ have, a table with boards
    of black and white squares stayed as rough as it had become before, until that turn came."""
    occupancy = Occupancy(grid)
    turns, planes, found = occupancy.turns, [], list[torch.Tensor]()
    looked_at = torch.zeros(grid**3, dtype=torch.int64)

    def sdf(x: torch.Tensor) -> torch.Tensor:
        found.append(((x + 1) * grid / 2).long())
        return torch.zeros(len(x))

    for turn in range(7, 7 + turns):
        found.clear()
        occupancy.states.fill_(OUTSIDE)
        occupancy.update(sdf, 100.0, turn)
        index = torch.cat(found)
        looked_at[(index[:, 0] * grid + index[:, 1]) * grid + index[:, 2]] += 1
        planes += [torch.bincount(index[:, axis], minlength=grid) for axis in range(3)]
    assert (looked_at == 1).all()
    counts = torch.stack(planes).double() / (grid**2 / turns)  # of each plane in each turn, one if even
    assert turns <= 21 and (turns >= 16 or grid**3 <= 50_000 * turns)  # cells of a turn
    assert counts.min() > (0.9 if grid >= turns else 0) and counts.max() < 1 + 2 * turns / grid
    if grid == 96:
        row(
            "the cells of a plane of the occupancy grid, looked at anew",
            "every 16th of all cells: those of a plane are one such set, and wait for one turn",
            f"every {turns}th: {100 * counts.min():.0f} to {100 * counts.max():.0f} % of an even share in every turn and plane",
        )


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_occupancy_loses_no_surface(way: str, extent: float) -> None:
    parts = _parts(extent=extent)
    sets = [_towards(100, miss) for miss in (0.0, 0.3, 0.48, 0.49, 0.51, 0.6)]
    rays = [torch.cat(x) for x in zip(*sets, strict=True)]
    full = _trace(way, parts, *rays)
    parts[2].update(lambda x: parts[0](x, 2), SAMPLING.sharpness)
    pruned = _trace(way, parts, *rays)
    assert pruned.samples < full.samples
    torch.testing.assert_close(pruned.opacity, full.opacity, atol=0.02, rtol=0)
    # rays that hit it; those that graze it lose some light there, and meet half of it elsewhere in a section behind
    assert (full.opacity[:200] > 0.999).all()
    torch.testing.assert_close(pruned.depth[:200], full.depth[:200], atol=2e-4, rtol=0)
    assert torch.equal(pruned.depth.isnan(), full.depth.isnan())


# --- the hash grid


@pytest.mark.parametrize("way", WAYS)
def test_one_hash_level(row: Row, way: str) -> None:
    grid = HashGrid(1, 8, 4, 100)
    assert torch.isfinite(grid(torch.rand(5, 3), 1)).all() and grid.resolutions.tolist() == [4]
    parts = _parts(levels=1)
    hits = _trace(way, parts, *_towards(50, 0.3), Sampling(400.0, 0.005, 1, 1))
    exact = torch.full((50,), 3 - np.sqrt(0.25 - 0.09)).to(hits.depth)
    torch.testing.assert_close(hits.depth, exact, atol=3e-4, rtol=0)
    assert hits.features.shape == (50, 4)
    # instant-ngp: per-level scale exp(ln(b / a) / (L - 1)), in the kernel exp2(level log2(scale)) a - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        usual = np.exp2(0 * np.log2(np.exp(np.log(100 / 4) / np.float64(0)))) * 4 - 1
    assert np.isnan(usual)
    row(
        f"one hash level, {way}",
        "instant-ngp's scale of it, exp(ln(b / a) / (L - 1)): inf, and its resolution NaN",
        f"depth to {float((hits.depth - exact).abs().max()):.0e}",
    )


def test_no_active_level() -> None:
    parts = _parts()
    assert not parts[1](torch.rand(5, 3), 0).any()
    for way in WAYS:
        hits = _trace(way, parts, *_towards(50, 0.3), Sampling(400.0, 0.005, 0, 0))
        assert (hits.opacity > 0.99).all() and not hits.features.any()


def test_places_on_the_border_of_the_cube_are_in_the_last_cell() -> None:
    """The corner itself would be a cell beyond the last."""
    grid = HashGrid(2, 10, 3, 9)
    surface = Surface(grid, 4, (0.5, 1e9))
    with torch.no_grad():
        surface.output_weight.normal_()
        grid.table.normal_()
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    inside = corners * (1 - 1e-5)
    torch.testing.assert_close(grid(corners, 2), grid(inside, 2), atol=1e-3, rtol=0)
    torch.testing.assert_close(surface(corners, 2), surface(inside, 2), atol=1e-3, rtol=0)
    torch.testing.assert_close(surface(corners, 2), reference.surface_value(corners, *surface.at(2)), atol=1e-6, rtol=1e-6)


def test_trace_chooses_the_interval_that_the_grid_has() -> None:
    origins, directions = _towards(20, 0.3)
    found = trace(*_parts(), origins, directions, torch.full((20,), 0.5), SAMPLING)
    expected = _trace("fused", _parts(), origins, directions)
    assert torch.equal(found.opacity, expected.opacity) and torch.equal(found.depth, expected.depth)
    beyond = trace(*_parts(extent=2.0), origins, -directions, torch.full((20,), 0.5), SAMPLING)
    assert (beyond.depth > 5).all() and (beyond.opacity > 0.99).all()  # the horizon, behind the camera
    assert reference.MAX_SAMPLES_PER_RAY == marching.MAX_SAMPLES_PER_RAY
