"""Hard cases of mirrored light, and of pixels that see two surfaces: what the usual formula does, and the bound that ours keeps."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import Lamps, Measured, Mirrors, Sampling
from mmsynth.field.kernels.mirroring import reflect
from mmsynth.field.light import LAMPS, find_lamps
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.rendering import trace
from mmsynth.field.surface import Surface

Row = Callable[[str, str, str], None]
UP = (0.0, 0.0, 1.0)


def _mirrors(normals: Tensor, viewers: Tensor, raw: tuple[float, float, float]) -> Mirrors:
    """Surfaces at the origin with normals (N, 3), seen from directions (N, 3)."""
    n = len(normals)
    return Mirrors(
        torch.tensor([*raw[:2], -30.0, -30.0, 30.0, raw[2]]).to(normals).expand(n, 6).clone(),
        normals,
        torch.zeros_like(normals),
        -viewers,
        torch.ones(n).to(normals),
    )


def _light(mirrors: Mirrors, lamp: Tensor) -> tuple[Tensor, Tensor]:
    """One lamp's light, (N,), by the fused kernel in float32, and the gradient to the normals."""
    mirrors = mirrors._replace(normals=mirrors.normals.clone().requires_grad_())
    n = len(mirrors.share)
    one, ray = torch.ones(n), torch.arange(n)
    measured = Measured(one, ray, torch.zeros_like(ray), torch.empty(0, 3), one, one, one)
    seen = kernels.mirror(Lamps(lamp.expand(1, 3), torch.ones(1, 1)), mirrors, torch.full((n,), -1), measured)
    seen.sum().backward()
    assert mirrors.normals.grad is not None
    return seen.detach(), mirrors.normals.grad


def _around(count: int, degrees: float) -> Tensor:
    """Unit vectors this far from the z axis."""
    turn = torch.linspace(0, 2 * math.pi, count + 1)[:count]
    side = math.sin(math.radians(degrees))
    return torch.stack([side * turn.cos(), side * turn.sin(), torch.full_like(turn, math.cos(math.radians(degrees)))], 1)


def test_roughness_to_0(row: Row) -> None:
    """A lobe of 0.02 rad, in float32: 1 - cos² has lost what the cross product still has."""
    off = torch.linspace(1e-4, 0.02, 200)
    normals = normalize(torch.stack([off.sin(), torch.zeros_like(off), off.cos()], 1), dim=1)
    mirrors = _mirrors(normals, torch.tensor([UP]).expand(200, 3), (-30.0, 0.0, 30.0))
    exact = reflect(torch.tensor([[0.0, 0.0, 5.0]]).double(), Mirrors(*(x.double() for x in mirrors))).amount[:, 0]
    found, gradient = _light(mirrors, torch.tensor([0.0, 0.0, 5.0]))
    square = torch.tensor(0.02) ** 2
    by_cosine = lambda x, square: (square / ((x[:, 2] ** 2) * (square - 1.0) + 1.0)) ** 2
    usual, true = by_cosine(normals, square), by_cosine(normals.double(), square.double())
    worst, wrong = float(((found - exact) / exact).abs().max()), float(((usual - true) / true).abs().max())
    assert worst < 1e-5 < 1e-4 < wrong and torch.isfinite(gradient).all()
    row("a lobe of roughness 0.02, float32", f"GGX by the cosine: off by {wrong:.0e}", f"{worst:.0e}")


def test_roughness_to_1() -> None:
    """A lobe as wide as the hemisphere: no division by 1 - α², and nothing from behind."""
    normals = torch.cat([_around(50, angle) for angle in (0.0, 60.0, 89.0, 120.0)])
    found, gradient = _light(_mirrors(normals, torch.tensor([UP]).expand(200, 3), (30.0, 0.0, 30.0)), torch.tensor([0.0, 0.0, 5.0]))
    assert torch.isfinite(found).all() and torch.isfinite(gradient).all()
    assert (found[:150] > 0).all() and not found[150:].any() and not gradient[150:].any()


def test_grazing_light_and_view(row: Row) -> None:
    """Cook and Torrance's 1 / (4 n·l n·v) without masking has no bound."""
    angles = torch.tensor([80.0, 89.0, 89.9, 89.99])
    side, top = torch.deg2rad(angles).sin(), torch.deg2rad(angles).cos()
    viewers = torch.stack([side, torch.zeros(4), top], 1)
    lamps = 5.0 * viewers * torch.tensor([-1.0, 1.0, 1.0])
    normal, raw = torch.tensor([UP]), (-2.0, 0.0, 30.0)
    found = torch.cat([_light(_mirrors(normal, v[None], raw), lamp)[0] for v, lamp in zip(viewers, lamps, strict=True)])
    usual = 0.25 / (top * top)
    assert float(found.max()) < 100.0 < float(usual.max())
    row("lamp and viewer 0.01° above the surface", f"D F / (4 n·l n·v): {float(usual[-1]):.1e} times the lamp", f"{float(found[-1]):.2g}")


def test_lamps_and_viewers_below_the_horizon() -> None:
    """Nothing is seen, and nothing pulls at the normal."""
    normals = -_around(60, 30.0)
    for lamp in ((0.0, 0.0, 5.0), (5.0, 0.0, 0.1)):
        found, gradient = _light(_mirrors(normals, _around(60, 10.0), (0.0, 0.0, 30.0)), torch.tensor(lamp))
        assert torch.isfinite(found).all() and torch.isfinite(gradient).all() and not found[(normals @ torch.tensor(lamp)) < 0].any()


def test_normals_at_the_poles(row: Row) -> None:
    """The azimuth of a normal has no bound to its slope at the poles; vectors have no poles."""
    normals = torch.tensor([[1e-7, 0.0, 1.0], [1e-7, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    viewers = normalize(normals + torch.tensor([0.3, 0.2, 0.1]), dim=1)
    angles = normals.clone().requires_grad_()
    torch.atan2(angles[:, 1], angles[:, 0]).sum().backward()
    assert angles.grad is not None
    steepest, ours = float(angles.grad.abs().max()), 0.0
    for n, v in zip(normals, viewers, strict=True):
        _, gradient = _light(_mirrors(n[None], v[None], (0.0, 0.0, 30.0)), 4.0 * normalize(n + torch.tensor([-0.2, 0.3, 0.2]), dim=0))
        assert torch.isfinite(gradient).all() and gradient.any()
        ours = max(ours, float(gradient.abs().max()))
    assert ours < 10.0 < 1e6 < steepest
    row("a normal along z", f"azimuth by atan2: a gradient of {steepest:.0e}", f"{ours:.1f}")


def test_a_mirror_seen_head_on_is_not_polarized(row: Row) -> None:
    """Lamp, viewer and normal in one line: v × h has no direction, and the degree is 0 whatever the axis."""
    n = torch.tensor([UP, (0.0, 1.0, 0.0)])
    image = reflect(4.0 * n, _mirrors(n, n, (0.0, 0.0, 0.0))._replace(material=torch.zeros(2, 7)))
    usual = torch.linalg.cross(n, n) / torch.linalg.cross(n, n).norm(dim=1, keepdim=True)
    own = image.degree.diagonal()
    assert usual.isnan().all() and torch.isfinite(image.axis).all() and float(own.abs().max()) < 1e-6
    row("polarization of a mirror seen head on", "v × h over its length: NaN", f"degree {float(own.abs().max()):.0e}")


def test_a_highlight_on_an_unpolarized_body_is_polarized_no_more_than_its_light() -> None:
    """Degree ≤ 1 of the mirrored part at any angle; behind crossed analysers the two intensities add up to the light."""
    viewers = torch.cat([_around(36, angle) for angle in (1.0, 30.0, 56.3, 80.0, 89.5)])
    mirrors = _mirrors(torch.tensor([UP]).expand(len(viewers), 3), viewers, (0.0, 0.0, 30.0))
    lamps, n = Lamps(torch.tensor([[1.0, 2.0, 3.0]]), torch.ones(1, 1)), len(viewers)
    x = normalize(torch.linalg.cross(viewers, torch.tensor([[0.3, 0.2, 0.1]]).expand(n, 3)), dim=1)
    y = torch.linalg.cross(x, viewers)
    one, ray, none = torch.ones(n), torch.arange(n), torch.full((n,), -1)
    behind = lambda axes: kernels.mirror(lamps, mirrors, none, Measured(one, ray, torch.zeros_like(ray), axes, one, one, one))
    whole = behind(torch.empty(0, 3))
    assert (behind(x) >= 0).all() and (behind(y) >= 0).all()
    torch.testing.assert_close(behind(x) + behind(y), whole, atol=1e-6, rtol=1e-5)


def test_a_lamp_in_the_picture() -> None:
    """A ray that ends at the lamp itself: no distance to it, no direction; a finite light and gradient."""
    normals = _around(8, 40.0)
    found, gradient = _light(_mirrors(normals, _around(8, 10.0), (0.0, 0.0, 30.0)), torch.zeros(3))
    assert torch.isfinite(found).all() and torch.isfinite(gradient).all()


def test_a_highlight_brighter_than_full_scale_asks_for_nothing_more(row: Row) -> None:
    """Clipped pixels say "at least": a mirror that is brighter has no residual, one that is darker has."""
    target, level = torch.tensor([1.0, 1.0]), torch.full((2,), 0.2)
    measured = Measured(target, torch.arange(2), torch.zeros(2, dtype=torch.int64), torch.empty(0, 3), level, target, torch.full((2,), 0.5))
    mirrored = torch.tensor([20.0, 2.0])
    ours = kernels.residual(mirrored * level, measured)
    usual = mirrored * level - target
    assert float(usual[0]) == pytest.approx(3.0) and float(ours[0]) == 0.0 and float(ours[1]) == pytest.approx(-0.6)
    row("a highlight of four times full scale", f"residual {float(usual[0]):.0f}", "0")


def test_a_lamp_that_the_first_look_misses(row: Row) -> None:
    """On a rough surface, 30° beside two strong lamps is still brighter than at a weak one: what is found there takes its place."""
    g = torch.Generator().manual_seed(0)
    lamps = normalize(torch.tensor([[1.0, 0.0, 0.0], [-0.17, 0.985, 0.0], [-0.5, -0.6, 0.6]]), dim=1)
    normals, viewers = (normalize(torch.randn(20000, 3, generator=g), dim=1) for _ in range(2))
    viewers = torch.where((viewers * normals).sum(1, keepdim=True) < 0, -viewers, viewers)
    reflected = 2.0 * (viewers * normals).sum(1, keepdim=True) * normals - viewers
    each = reflect(100.0 * lamps, _mirrors(normals, viewers, (1.0, 0.0, 30.0))).amount * torch.tensor([1.0, 1.0, 0.4])
    light, strong = each.sum(1), lamps[:2]
    first, masked = find_lamps(reflected, light), find_lamps(reflected, light, light, strong)
    ours = find_lamps(reflected, light, each[:, 2], strong)
    off = lambda found: math.degrees(math.acos(float((found @ lamps[2]).max())))
    assert len(first) == LAMPS and off(first) > 60 and float((first @ strong.T).amax(0).min()) > math.cos(math.radians(10.0))
    assert len(masked) == LAMPS - 2 and off(masked) > 60
    assert len(ours) == 1 and off(ours) < 8
    row(
        "a weak lamp beside two strong ones, roughness 0.7",
        f"one look: {len(first)} directions, {off(first):.0f}° off; again, in all light away from the strong ones: {off(masked):.0f}°",
        f"again, in what the strong ones do not explain: {off(ours):.0f}° off, and none but it",
    )


@pytest.mark.parametrize("way", ["fused", "single operations"])
def test_an_edge_is_two_surfaces(way: str, row: Row) -> None:
    """Rays past the rim of a ball, before a wall all around it: the mean of the features is that of a place where nothing is."""
    surface = Surface(HashGrid(1, 10, 8, 8, 2.0), 4, (0.3, 1.0))
    appearance = HashGrid(1, 10, 8, 8, 2.0)
    cells = torch.stack(torch.meshgrid(*[torch.arange(9)] * 3, indexing="ij"), -1).reshape(-1, 3)
    with torch.no_grad():  # the features are the place
        appearance.table[:, :3] = cells / 2.0 - 2.0
        appearance.table[:, 3] = 0.0
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(64, 3)
    aside = torch.linspace(0.3, 0.302, 64)
    origins = torch.stack([aside, torch.zeros(64), torch.full((64,), -0.9)], 1)
    sampling, middle, occupancy = Sampling(200.0, 0.005, 1, 1), torch.full((64,), 0.5), Occupancy(16, 2.0)
    if way == "fused":
        hits = trace(surface, appearance, occupancy, origins, directions, middle, sampling)
    else:
        hits = trace(surface.double(), appearance.double(), occupancy, origins.double(), directions.double(), middle.double(), sampling)
    assert (hits.behind >= 0).all() and float((hits.opacity.detach() - 1).abs().max()) < 0.02
    z = hits.features.detach()[:, 2]
    ball, wall = z[:64], z[hits.behind]
    share = hits.share.detach()[:64]
    assert float(share.min()) < 0.5 < float(share.max())
    assert float(ball.abs().max()) < 0.06 and float((wall - (1 - aside**2).sqrt()).abs().max()) < 0.02
    mean = share * ball + hits.share.detach()[hits.behind] * wall
    off = float(torch.minimum((mean - ball).abs(), (mean - wall).abs()).max())
    assert off > 0.4
    if way == "fused":
        row("a pixel half on an edge", f"features of a place {off:.1f} radii from either surface", "those of both")
