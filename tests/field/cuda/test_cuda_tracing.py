import copy

import pytest
import torch
from torch import Tensor

from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import OUTSIDE, SHELL, SOLID, Hits, Rays, Sampling, cuda, reference
from mmsynth.field.kernels.constants import MAX_SAMPLES_PER_RAY
from mmsynth.field.kernels.cuda import tracing
from mmsynth.field.rendering import FARTHEST, ball_interval
from mmsynth.field.surface import Surface

RAYS = 40


def _field(device: str, extent: float, bumps: float = 0.6) -> tuple[Surface, HashGrid]:
    """A bumpy ball before a horizon, and appearance of more levels than are looked up together."""
    surface, appearance = Surface(HashGrid(3, 8, 3, 12, extent), 8, (0.4, 1.6)), HashGrid(6, 8, 3, 20, extent)
    torch.nn.init.normal_(surface.grid.table, std=bumps)
    torch.nn.init.normal_(surface.output_weight, std=0.5 * bumps)
    surface.output_weight.data[-1] = 0.0
    torch.nn.init.normal_(appearance.table)
    return surface.to(device), appearance.to(device)


def _states(kind: str, extent: float) -> Tensor:
    """Three-state grid: all shell, true to the ball, or as it comes."""
    if kind == "open":
        return torch.full((16,) * 3, SHELL, dtype=torch.uint8)
    if kind == "random":
        states = torch.randint(0, 60, (16,) * 3)
        return torch.where(states > 25, SHELL, torch.where(states == 3, SOLID, OUTSIDE + states // 8)).to(torch.uint8)
    axis = ((torch.arange(24) + 0.5) / 12 - 1) * extent
    free = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).square().sum(0).sqrt() - 0.4
    margin = extent * 3**0.5 / 24 + 0.3
    return torch.where(free > margin, OUTSIDE + (free - margin) * 24 / extent, torch.where(free < -margin, SOLID, SHELL)).to(torch.uint8)


def _rays(count: int, extent: float, device: str) -> Rays:
    """Rays that hit and miss the unit ball, that begin in it, and along an axis."""
    origins = torch.nn.functional.normalize(torch.randn(count, 3), dim=1) * 2.5
    directions = torch.nn.functional.normalize(0.4 * torch.randn(count, 3) - origins / 2.5, dim=1)
    origins[:4] *= 0.1
    directions[4:7] = -torch.eye(3)
    origins[4:7] = 2.0 * torch.eye(3) + 0.05
    directions[7] *= -1
    near, far = ball_interval(origins, directions) if extent == 1.0 else (torch.zeros(count), torch.full((count,), FARTHEST))
    return Rays(*(x.to(device) for x in (origins, directions, near, far, torch.rand(count))))


def _of_all_rays(hits: Hits) -> Hits:
    """The reference's hits with two rows for each ray, as the kernels give them."""
    count = len(hits.behind)
    to = torch.cat([torch.arange(count, device=hits.behind.device), torch.nonzero(hits.behind >= 0)[:, 0] + count])
    spread = lambda x: x.new_zeros(2 * count, *x.shape[1:]).index_copy(0, to, x)
    behind = torch.where(hits.behind < 0, -1, torch.arange(count, 2 * count, device=to.device))
    return hits._replace(features=spread(hits.features), share=spread(hits.share), distance=spread(hits.distance), behind=behind)


def _loss(hits: Hits) -> Tensor:
    """Every differentiable number matters, each differently."""
    wave = torch.arange(hits.features.numel(), device=hits.features.device, dtype=torch.float64).sin().reshape(hits.features.shape)
    column = wave[:, 0]
    found = (hits.features.double() * wave).sum() + (hits.share.double() * column).sum()
    return found + 3.0 * (hits.opacity.double() * column[: len(hits.opacity)]).sum()


CASES = [("open", 0.08, 1.0, 30.0), ("random", 0.05, 2.0, 60.0)]


@pytest.mark.parametrize(("states", "step", "extent", "sharpness"), CASES)
def test_trace_equals_reference_with_all_gradients(
    device: str, states: str, step: float, extent: float, sharpness: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracing, "MARCH_LANES", 32)  # fewer than rays: lanes take a second one
    surface, appearance = _field(device, extent)
    exact_surface, exact_appearance = copy.deepcopy(surface).double(), copy.deepcopy(appearance).double()
    grid, rays = _states(states, extent).to(device), _rays(RAYS, extent, device)
    sampling = Sampling(sharpness, step, 3, 5, max_optical_depth=4.0)
    leaves, exact_leaves = (
        [x.detach().to(dtype, copy=True).requires_grad_() for x in rays[:2]] for dtype in (torch.float32, torch.float64)
    )
    found = cuda.trace(*surface.at(3), appearance.at(5), grid, Rays(*leaves, *rays[2:]), sampling)
    exact_rays = Rays(*exact_leaves, *(x.double() for x in rays[2:]))
    expected = _of_all_rays(reference.trace(*exact_surface.at(3), exact_appearance.at(5), grid, exact_rays, sampling))
    assert found.features.shape == (2 * RAYS, 24) and expected.samples > 2 * RAYS
    assert abs(int(found.samples) - int(expected.samples)) <= 0.01 * int(expected.samples)
    met_twice = expected.behind >= 0
    assert met_twice.any() and not met_twice.all()
    # a sample within rounding of a cell's face may fall either way, and with it the rest of its ray
    close = (found.opacity.double() - expected.opacity).abs() < 1e-4
    same = (found.behind == expected.behind) & close & ((found.depth - expected.depth).abs() < 1e-3).logical_or(expected.depth.isnan())
    assert same.double().mean() > 0.95
    rows = torch.cat([same, same])
    for name in ("features", "share", "distance"):
        error = (getattr(found, name).double() - getattr(expected, name))[rows].abs().max()
        assert error < 2e-3, name
    assert torch.equal(found.depth.isnan()[same], expected.depth.isnan()[same])
    empty = torch.cat([torch.zeros_like(found.behind, dtype=torch.bool), found.behind < 0])
    assert not found.share[empty].any() and not found.distance[empty].any() and not found.features[empty].any()
    # gradients of the rays that are the same
    for hits in (found, expected):
        _loss(hits._replace(features=hits.features * rows[:, None], share=hits.share * rows, opacity=hits.opacity * same)).backward()
    pairs = {name: (p, q) for (name, p), q in zip(surface.named_parameters(), exact_surface.parameters(), strict=True)}
    pairs |= {"appearance": (appearance.table, exact_appearance.table), "origins": (leaves[0], exact_leaves[0])}
    for name, (p, q) in (pairs | {"directions": (leaves[1], exact_leaves[1])}).items():
        assert q.grad.any(), name
        assert (p.grad.double() - q.grad).abs().max() < 2e-3 * q.grad.abs().max(), name


def test_only_some_outputs_have_gradients(device: str) -> None:
    """Opacity alone, features alone, and rays that are fixed: the same gradients as together."""
    surface, appearance = _field(device, 1.0)
    grid, rays = _states("open", 1.0).to(device), _rays(8, 1.0, device)
    found: dict[str, Tensor] = {}
    for name, of in {"features": lambda h: h.features.square().sum(), "opacity": lambda h: h.opacity.square().sum()}.items():
        surface.zero_grad(), appearance.zero_grad()
        of(cuda.trace(*surface.at(3), appearance.at(6), grid, rays, Sampling(20.0, 0.2, 3, 6))).backward()
        found[name] = surface.hidden.grad.clone()
        assert bool(appearance.table.grad is not None and appearance.table.grad.any()) == (name == "features")
    surface.zero_grad()
    hits = cuda.trace(*surface.at(3), appearance.at(6), grid, rays, Sampling(20.0, 0.2, 3, 6))
    (hits.features.square().sum() + (hits.share[:8] + hits.share[8:]).square().sum()).backward()
    torch.testing.assert_close(surface.hidden.grad, found["features"] + found["opacity"], atol=1e-4, rtol=1e-4)


def test_numbers_that_change_may_lie_on_the_device(device: str) -> None:
    surface, appearance = _field(device, 1.0)
    grid, rays = _states("true", 1.0).to(device), _rays(8, 1.0, device)
    on_device = [torch.tensor(x, dtype=torch.float64, device=device) for x in (20.0, 0.2)]
    with torch.no_grad():
        a = cuda.trace(*surface.at(3), appearance.at(6), grid, rays, Sampling(20.0, 0.2, 3, 6))
        b = cuda.trace(*surface.at(3), appearance.at(6), grid, rays, Sampling(*on_device, 3, 6))
    assert all(torch.equal(x, y) for x, y in zip(a[:5], b[:5], strict=True))


def test_samples_and_weights_have_the_same_bits_again(device: str) -> None:
    """Whichever lane takes a ray."""
    surface, appearance = _field(device, 2.0)
    grid, rays = _states("random", 2.0).to(device), _rays(10, 2.0, device)
    bits = []
    for _ in range(2):
        surface.zero_grad()
        hits = cuda.trace(*surface.at(3), appearance.at(6), grid, rays, Sampling(30.0, 0.2, 3, 6))
        _loss(hits).backward()
        bits.append([hits.features.detach(), hits.share.detach(), surface.hidden.grad.clone(), surface.output_weight.grad.clone()])
    assert all(torch.equal(a, b) for a, b in zip(*bits, strict=True))


def test_no_rays_and_rays_that_meet_nothing(device: str) -> None:
    surface, appearance = _field(device, 1.0)
    for count in (0, 9):
        rays = Rays(*(x[:count] for x in _rays(9, 1.0, device)))
        empty = torch.full((4, 4, 4), OUTSIDE, dtype=torch.uint8, device=device)
        hits = cuda.trace(*surface.at(3), appearance.at(6), empty, rays, Sampling(60.0, 0.02, 3, 6))
        assert hits.features.shape == (2 * count, 24) and not hits.features.any() and not hits.share.any()
        assert hits.depth.isnan().all() and (hits.behind == -1).all() and hits.samples == 0
        _loss(hits).backward()
        assert not surface.hidden.grad.any() and not surface.output_weight.grad.any()
        surface.zero_grad()


def test_a_ray_from_afar_comes_to_an_end(device: str) -> None:
    """A step is less than float32 resolves at the distance of the camera."""
    surface, appearance = _field(device, 1.0, bumps=1e-3)
    rays = Rays(*(torch.tensor(x, device=device) for x in ([[0.0, 0.0, -5e4]], [[0.0, 0.0, 1.0]], [5e4 - 1], [5e4 + 1], [0.5])))
    states = torch.full((7, 7, 7), OUTSIDE, dtype=torch.uint8, device=device)
    states[:, :, 5:] = SHELL
    with torch.no_grad():
        hits = cuda.trace(*surface.at(3), appearance.at(6), states, rays, Sampling(60.0, 1e-4, 3, 6))
    assert 0 < hits.samples <= MAX_SAMPLES_PER_RAY


def test_not_a_number_is_not_hidden(device: str) -> None:
    surface, appearance = _field(device, 1.0)
    with torch.no_grad():
        surface.grid.table[:10] = torch.nan
    hits = cuda.trace(*surface.at(3), appearance.at(6), _states("open", 1.0).to(device), _rays(30, 1.0, device), Sampling(20.0, 0.2, 3, 6))
    assert hits.share.isnan().any() and not hits.share.isnan().all()
    hits.share.sum().backward()
    assert surface.hidden.grad.isnan().any()
