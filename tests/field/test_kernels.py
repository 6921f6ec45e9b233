"""The fused CPU kernels in float32 against the same thing from single operations in float64: values and gradients.

Tolerances are relative to the largest value of each quantity, and a few times what float32 leaves of it: the reference in
float32 is as far from float64.
"""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest
import torch
from torch.nn.functional import normalize

from mmsynth.field import kernels, rendering
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import OUTSIDE, SHELL, SOLID, Sampling, cpu, reference
from mmsynth.field.kernels.cpu import stores
from mmsynth.field.kernels.cpu.marching import CHUNK
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.surface import Surface
from mmsynth.field.warmup import warm_up
from mmsynth.threads import kernel_threads


def assert_near(found: torch.Tensor, expected: torch.Tensor, tolerance: float, name: str) -> None:
    """Within ``tolerance`` of the largest expected value everywhere, and within half of it of the norm."""
    assert found.dtype == torch.float32 and expected.dtype == torch.float64 and found.shape == expected.shape, name
    found, expected = found.detach().double(), expected.detach()
    assert torch.equal(found.isnan(), expected.isnan()), name
    found, expected = found.nan_to_num(), expected.nan_to_num()
    worst = float((found - expected).abs().max() / expected.abs().max().clamp(min=1e-30))
    assert worst < tolerance, f"{name}: apart by {worst:.1e} of the largest"
    apart = float((found - expected).norm() / expected.norm().clamp(min=1e-30))
    assert apart < tolerance / 2, f"{name}: apart by {apart:.1e} of the norm"


# --- distances

GRIDS = {
    "dense and hashed": (5, 10, 4, 60),  # of 5³, 9³ (dense), 16³, 31³, 61³ corners in 1024 rows
    "dense": (2, 12, 3, 7),
    "one level": (1, 8, 20, 20),
}


def _surface(grid: str, extent: float, hidden: int = 12) -> Surface:
    torch.manual_seed(0)
    surface = Surface(HashGrid(*GRIDS[grid], extent), hidden, (0.5, 1.9 if extent > 1 else 1e9))
    with torch.no_grad():
        surface.grid.table.normal_(0, 0.3)
        surface.output_weight.normal_(0, 0.3)
    return surface


def _positions(count: int, grid: HashGrid) -> torch.Tensor:
    """Places in the cube, none within rounding of a cell's face, where the slope jumps."""
    found = torch.empty(0, 3)
    generator = torch.Generator().manual_seed(count)
    while len(found) < count:
        x = torch.rand(2 * count, 3, generator=generator) * 2 - 1
        scaled = (x.double() * 0.5 + 0.5)[..., None] * grid.resolutions
        found = torch.cat([found, x[((scaled - scaled.round()).abs() > 1e-4).all(-1).all(-1)]])
    return found[:count] * grid.extent


@pytest.mark.parametrize("count", [0, 1, 127, 128, 129, 1000])
@pytest.mark.parametrize(
    ("grid", "extent", "active"),
    [("dense and hashed", 1.0, 5), ("dense and hashed", 2.0, 5), ("dense and hashed", 1.0, 2), ("dense", 1.0, 2), ("one level", 2.0, 1)],
)
def test_surface_value(grid: str, extent: float, active: int, count: int) -> None:
    surface = _surface(grid, extent)
    exact = copy.deepcopy(surface).double()
    a = _positions(count, surface.grid).requires_grad_()
    b = a.detach().double().requires_grad_()
    found, expected = surface(a, active), reference.surface_value(b, *exact.at(active))
    assert found.shape == (count,)
    gradient = torch.randn(count, generator=torch.Generator().manual_seed(1))
    found.backward(gradient)
    expected.backward(gradient.double())
    parts = {"positions": (a, b), "hidden": (surface.hidden, exact.hidden), "last": (surface.output_weight, exact.output_weight)}
    parts["table"] = surface.grid.table, exact.grid.table
    if not count:
        assert all(not p.grad.any() for p, _ in parts.values() if p.grad is not None) and surface.hidden.grad is not None
        return
    assert_near(found, expected, 5e-6, "distance")
    for name, (p, q) in parts.items():
        assert_near(p.grad, q.grad, 2e-5, f"gradient of {name}")
    first = int(surface.grid.offsets[active])
    assert surface.grid.table.grad[:first].any() and not surface.grid.table.grad[first:].any()


def test_more_active_levels_than_there_are_is_all() -> None:
    surface = _surface("dense", 1.0)
    x = _positions(200, surface.grid)
    assert torch.equal(surface(x, 40), surface(x, 2))
    torch.testing.assert_close(surface(x, 40), reference.surface_value(x, *surface.at(40)), atol=1e-5, rtol=0)


def test_layouts_of_what_comes_in() -> None:
    """Transposed positions, a gradient of stride 0."""
    surface = _surface("dense", 1.0)
    x = _positions(200, surface.grid)
    turned = x.T.contiguous().T.requires_grad_()
    plain = x.clone().requires_grad_()
    for y in (turned, plain):
        surface(y, 2).sum().backward()
    assert not turned.is_contiguous() and torch.equal(turned.grad, plain.grad)
    assert torch.equal(surface(turned, 2), surface(plain, 2))


def test_gradients_of_tables_are_added() -> None:
    surface = _surface("dense and hashed", 1.0)
    x = _positions(300, surface.grid)
    surface(x, 5).square().sum().backward()
    once = surface.grid.table.grad.clone()
    table_gradient = surface.grid.table.grad
    (surface(x, 5).square().sum() + surface(x, 5).square().sum()).backward()
    assert surface.grid.table.grad is table_gradient
    torch.testing.assert_close(surface.grid.table.grad, 3 * once, atol=1e-5, rtol=1e-5)


def test_frozen_parts_get_no_gradient() -> None:
    surface = _surface("dense", 1.0)
    surface.grid.table.requires_grad_(False)
    x = _positions(100, surface.grid).requires_grad_()
    surface(x, 2).sum().backward()
    assert surface.grid.table.grad is None and x.grad is not None and surface.hidden.grad is not None
    surface.requires_grad_(False)
    assert not surface(x.detach(), 2).requires_grad


def test_values_are_the_same_without_a_gradient() -> None:
    surface = _surface("dense and hashed", 1.0)
    x = _positions(1000, surface.grid)
    kept = surface(x, 5)
    with torch.no_grad():
        assert torch.equal(surface(x, 5), kept)
    surface.requires_grad_(False)
    assert torch.equal(surface(x, 5), kept)


def test_nothing_is_stored_where_no_gradient_can_be_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rendering 8192 rays would else keep 32 chunks, hundreds of megabytes."""
    slots = []
    store = stores.Store
    monkeypatch.setattr(stores, "Store", lambda n, kind, sizes: slots.append(n) or store(n, kind, sizes))
    surface, appearance, occupancy = _parts(1.0, "open", 0)
    origins, directions, jitter = (x.detach() for x in _rays(600, 0))
    with torch.no_grad():
        surface(torch.zeros(5000, 3), 3)
        rendering.trace(surface, appearance, occupancy, origins, directions, jitter, SAMPLINGS["soft"])
    assert slots == [kernel_threads()] * 2
    rendering.trace(surface, appearance, occupancy, origins, directions, jitter, SAMPLINGS["soft"])
    assert slots[2:] == [-(-600 // CHUNK)]


def test_stores_are_used_again_and_let_go_when_nobody_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "_pool", pool := [])
    first, large = stores.tap_store(4, 8, 2), stores.tap_store(40, 8, 2)
    block, wide = first.arrays.block, large.arrays.block
    assert len(block) == 4 and len(wide) >= 40
    del first, large
    for _ in range(300):  # in turns: both stay
        assert stores.tap_store(3, 8, 2).arrays.block is block
        assert stores.tap_store(33, 8, 2).arrays.block is wide
    for _ in range(300):  # the large one is not used for a small call, and goes
        assert stores.tap_store(3, 8, 2).arrays.block is block
    assert [arrays.block is block for _, arrays, _ in pool] == [True]


def test_larger_stores_take_the_place_of_smaller_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Need that swings about a power of two would keep both; where they differ by more, calls in turns keep theirs."""
    monkeypatch.setattr(stores, "_pool", pool := [])
    for slots in (8, 100, 9):
        stores.tap_store(slots, 8, 2)
    assert sorted(len(arrays.block) for _, arrays, _ in pool) == [16, 128]
    between = stores.tap_store(8, 8, 2).arrays.block
    assert len(between) == 16 and between is stores.tap_store(16, 8, 2).arrays.block


def test_hidden_units_come_in_fours() -> None:
    """The kernels take four at a time; they would read past the end of a fifth."""
    with pytest.raises(ValueError, match="multiple of 4"):
        _surface("dense", 1.0, hidden=6)


# --- rays

SAMPLINGS = {
    "soft": Sampling(40.0, 0.05, 3, 2),
    "sharp": Sampling(400.0, 0.005, 3, 2),
    "coarse": Sampling(10.0, 0.1, 2, 1, max_optical_depth=8.0, min_section_weight=0.05),  # not all levels
    "slow": Sampling(20.0, 0.01, 3, 2, sphere_step_factor=0.1, min_slope=1.0, max_optical_depth=8.0),  # rays of the most samples
}
# what float32 leaves: most is lost in gradients that are sums of large numbers of both signs
TOLERANCES = {
    "features": 1e-4, "share": 5e-5, "opacity": 5e-5, "depth": 2e-6, "gradient of the surface's table": 2e-4,
    "gradient of the appearance": 4e-5, "gradient of hidden": 1.5e-4, "gradient of last": 1e-4, "gradient of origins": 2e-4,
    "gradient of directions": 2e-4,
}  # fmt: skip


def _parts(extent: float, states: str, seed: int, levels: int = 3) -> tuple[Surface, HashGrid, Occupancy]:
    """A random field. states: of its own surface, all shell, or random ones that have nothing to do with it."""
    torch.manual_seed(seed)
    surface = Surface(HashGrid(levels, 12, 8, 40, extent), 16, (0.5, 1.9 if extent > 1 else 1e9))
    appearance, occupancy = HashGrid(max(levels - 1, 1), 12, 8, 60, extent), Occupancy(32, extent)
    with torch.no_grad():
        surface.grid.table.normal_(0, 0.3)
        surface.output_weight.normal_(0, 0.05)
        appearance.table.normal_()
    if states == "own":
        occupancy.update(lambda x: surface(x, 3), 40.0)
        assert set(range(OUTSIDE + 3)) <= set(occupancy.states.unique().tolist())
    elif states == "random":
        number = torch.randint(0, 40, occupancy.states.shape)
        kind = torch.where(number < 25, SHELL, torch.where(number == 25, SOLID, number - 26 + OUTSIDE))
        occupancy.states.copy_(kind)
    return surface, appearance, occupancy


def _rays(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Most from around, an eighth from within; an eighth goes anywhere."""
    torch.manual_seed(100 + seed)
    origins = normalize(torch.randn(count, 3), dim=1) * 2.5
    origins[: count // 8] *= 0.35
    aim = 0.4 * torch.randn(count, 3)
    aim[count - count // 8 :] *= 10
    directions = normalize(aim - origins, dim=1)
    return origins.requires_grad_(), directions.requires_grad_(), torch.rand(count)


Parts = tuple[Surface, HashGrid, Occupancy]


def _quantities(
    parts: Parts, origins: torch.Tensor, directions: torch.Tensor, jitter: torch.Tensor, sampling: Sampling, exact: bool = False
) -> tuple[dict[str, torch.Tensor], rendering.Hits]:
    """Values, and gradients of a loss that depends on all of them; by the fused kernel, or in float64, where there is none."""
    surface, appearance, occupancy = parts
    if exact:
        surface, appearance = (copy.deepcopy(m).double() for m in (surface, appearance))
        origins, directions, jitter = origins.double(), directions.double(), jitter.double()
    origins, directions = (x.detach().requires_grad_() for x in (origins, directions))
    for module in (surface, appearance):
        module.zero_grad()
    hits = rendering.trace(surface, appearance, occupancy, origins, directions, jitter, sampling)
    weight = torch.linspace(0.5, 1.5, len(origins)).to(jitter)
    of_row = weight[kernels.rays_of(hits.behind, len(hits.share))]
    loss = (hits.features * of_row[:, None]).square().sum() + (hits.opacity * weight).square().sum()
    (loss + 0.5 * (hits.share * of_row).square().sum()).backward()
    return {
        "features": _per_ray(hits, hits.features), "share": _per_ray(hits, hits.share[:, None]),
        "opacity": hits.opacity, "depth": hits.depth / (1 + hits.depth),
        "gradient of the surface's table": surface.grid.table.grad, "gradient of the appearance": appearance.table.grad,
        "gradient of hidden": surface.hidden.grad, "gradient of last": surface.output_weight.grad,
        "gradient of origins": origins.grad, "gradient of directions": directions.grad,
    }, hits  # fmt: skip


def _per_ray(hits: rendering.Hits, rows: torch.Tensor) -> torch.Tensor:
    """(H, C) → (R, 2 C): of the nearest surface of each ray and of what is behind it, 0 where nothing is."""
    out = rows.detach().new_zeros(2, len(hits.behind), rows.shape[1])
    out[0], out[1, hits.behind >= 0] = rows.detach()[: len(hits.behind)], rows.detach()[len(hits.behind) :]
    return torch.cat([out[0], out[1]], 1)


Rays = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def _smooth(parts: Parts, rays: Rays, sampling: Sampling) -> torch.Tensor:
    """Rays at which nothing jumps within 1e-5: no unit that goes on or off, no face of a cell, no threshold. A matter of rounding."""
    origins, directions, jitter = (x.detach().double() for x in rays)
    shift = 1e-5 * torch.randn(origins.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    below, here, above = (_quantities(parts, origins + k * shift, directions, jitter, sampling, exact=True)[0] for k in (-1, 0, 1))
    keep = torch.ones(len(origins), dtype=torch.bool)
    for name in ("features", "share", "opacity", "depth", "gradient of origins"):
        a, b, c = (x[name].detach().reshape(len(origins), -1) for x in (below, here, above))
        keep &= ((a.isnan() == b.isnan()) & (b.isnan() == c.isnan())).all(1)
        keep &= (a - 2 * b + c).nan_to_num().abs().amax(1) < 1e-4 * b.nan_to_num().abs().max()
    return keep


def _compare(parts: Parts, rays: Rays, sampling: Sampling) -> rendering.Hits:
    keep = _smooth(parts, rays, sampling)
    assert keep.float().mean() > 0.8
    rays = rays[0][keep], rays[1][keep], rays[2][keep]
    found, hits = _quantities(parts, *rays, sampling)
    expected, exact = _quantities(parts, *rays, sampling, exact=True)
    assert int(hits.samples) == int(exact.samples)
    for name, tolerance in TOLERANCES.items():
        assert_near(found[name], expected[name], tolerance, name)
    return hits


def test_float32_is_fused_and_float64_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    parts, rays = _parts(1.0, "own", 0), _rays(10, 0)
    monkeypatch.setattr(reference, "trace", None)
    monkeypatch.setattr(reference, "surface_value", None)
    _quantities(parts, *rays, SAMPLINGS["soft"])
    monkeypatch.undo()
    monkeypatch.setattr(cpu, "trace", None)
    monkeypatch.setattr(cpu, "surface_value", None)
    _quantities(parts, *rays, SAMPLINGS["soft"], exact=True)


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize("states", ["own", "open", "random"])
@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_trace(extent: float, states: str, sampling: str) -> None:
    parts, rays = _parts(extent, states, 7), _rays(350, 7)
    hits = _compare(parts, rays, SAMPLINGS[sampling])
    near, far = rendering.ball_interval(rays[0].detach(), rays[1].detach())
    assert (near == 0).sum() > 30 and (near == far).sum() > 20  # rays from within, rays that miss the ball
    nothing = hits.opacity == 0
    assert hits.depth[nothing].isnan().all() and not hits.features[: len(nothing)][nothing].any()
    assert (hits.opacity > 0.7).sum() > 100 and (extent > 1.0 or nothing.any())
    twice = hits.behind >= 0
    assert torch.equal(hits.behind[twice], torch.arange(len(twice), len(hits.features))) and (twice.any() or sampling != "hard")
    if sampling == "slow" and states == "open":
        assert int(hits.samples) > 60 * len(hits.opacity)


@pytest.mark.parametrize("count", [1, CHUNK - 1, CHUNK, CHUNK + 1, 700])
def test_trace_of_parts_of_chunks(count: int) -> None:
    _compare(_parts(1.0, "own", 2), _rays(count, 5), SAMPLINGS["soft"])


@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_trace_with_one_level(extent: float) -> None:
    _compare(_parts(extent, "open", 3, levels=1), _rays(200, 3), Sampling(40.0, 0.05, 1, 1))


def test_trace_without_rays() -> None:
    parts = _parts(1.0, "own", 0)
    found, hits = _quantities(parts, torch.empty(0, 3), torch.empty(0, 3), torch.empty(0), SAMPLINGS["soft"])
    assert hits.features.shape == (0, 8) and hits.opacity.shape == hits.depth.shape == (0,) and int(hits.samples) == 0
    assert not any(g.any() for name, g in found.items() if name.startswith("gradient"))


def test_more_active_levels_of_a_trace_than_there_are_is_all() -> None:
    parts, rays = _parts(1.0, "own", 0), _rays(100, 0)
    (a, _), (b, _) = (_quantities(parts, *rays, Sampling(40.0, 0.05, *active)) for active in ((3, 2), (30, 20)))
    assert all(torch.equal(a[name].nan_to_num(), b[name].nan_to_num()) for name in a)


def test_a_trace_is_the_same_without_a_gradient() -> None:
    """Without one, what the backward pass needs is not kept, and the stores are of threads and not of chunks."""
    for extent in (1.0, 2.0):
        parts, rays = _parts(extent, "own", 4), _rays(600, 4)
        _, kept = _quantities(parts, *rays, SAMPLINGS["soft"])
        with torch.no_grad():
            first = rendering.trace(*parts, *rays, SAMPLINGS["soft"])
        for module in parts:
            module.requires_grad_(False)
        second = rendering.trace(*parts, *(x.detach() for x in rays), SAMPLINGS["soft"])
        for hits in (first, second):
            assert not hits.features.requires_grad and int(hits.samples) == int(kept.samples)
            for name in ("features", "share", "behind", "opacity", "depth"):
                assert torch.equal(getattr(hits, name).nan_to_num(), getattr(kept, name).nan_to_num()), name


def test_passes_do_not_share_what_they_keep() -> None:
    """Several forward passes before their backward passes, and stores that are taken again."""
    parts, sampling = _parts(1.0, "own", 5), SAMPLINGS["soft"]
    batches = [tuple(x.detach() for x in _rays(count, count)) for count in (300, 500, 300)]
    alone = []
    for batch in batches:
        parts[0].zero_grad()
        rendering.trace(*parts, *batch, sampling).opacity.square().sum().backward()
        alone.append([p.grad.clone() for p in (parts[0].hidden, parts[0].output_weight, parts[0].grid.table)])
    losses = [rendering.trace(*parts, *batch, sampling).opacity.square().sum() for batch in batches]
    for k in (1, 2, 0):
        parts[0].zero_grad()
        losses[k].backward()
        for p, expected in zip((parts[0].hidden, parts[0].output_weight, parts[0].grid.table), alone[k], strict=True):
            assert torch.equal(p.grad, expected)


@pytest.fixture
def torch_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("torch_threads")
@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_results_do_not_depend_on_the_number_of_threads(extent: float, use_threads: Callable[[int], None]) -> None:
    parts, rays = _parts(extent, "own", 6), _rays(1500, 6)  # several chunks
    x = _positions(3000, parts[0].grid)
    results = []
    for count in (1, 2, 5):
        use_threads(count)
        torch.set_num_threads(count)
        result, hits = _quantities(parts, *rays, SAMPLINGS["soft"])
        result |= {"samples": hits.samples, "distance": parts[0](x, 3)}
        parts[0].zero_grad()
        result["distance"].square().sum().backward()
        result |= {f"gradient of {n} by distances": p.grad for n, p in parts[0].named_parameters()}
        results.append({name: value.detach().clone() for name, value in result.items()})
    for other in results[1:]:
        for name, value in results[0].items():
            assert torch.equal(value.nan_to_num(), other[name].nan_to_num()), name


def test_is_compiled_says_so() -> None:
    """In a process that has run nothing yet: the kernels of this one are in the cache on disk."""
    warm_up()
    assert cpu.is_compiled()
    program = "from mmsynth.field.kernels import cpu; print(cpu.is_compiled())"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "True\n"


# --- cells of the three-state grid


@pytest.mark.parametrize("extent", [1.0, 2.0])
@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("grid", [3, 5, 32, 40])  # the last two: more than one task
def test_cells_are_those_of_the_definition(extent: float, turns: bool, grid: int, use_threads: Callable[[int], None]) -> None:
    """To the bit, while the surface moves, and by any number of threads."""
    surface, *_ = _parts(extent, "shell", 4)
    ours, theirs, alone = (Occupancy(grid, extent) for _ in range(3))
    for step, sharpness in enumerate((20.0, 60.0, 400.0, 90.0)):
        with torch.no_grad():
            surface.grid.table.mul_(0.8)
        turn = step if turns else None
        open_ = theirs.update(lambda x: surface(x, 3), sharpness, turn)
        for threads, cells in ((3, ours), (1, alone)):
            use_threads(threads)
            assert cells.update(surface.at(3), sharpness, turn) == open_
        assert torch.equal(ours.states, theirs.states) and torch.equal(alone.states, theirs.states)
    assert grid < 32 or len(ours.states.unique()) > 5


def test_a_cell_whose_distance_is_not_a_number_stays_open() -> None:
    surface, *_ = _parts(1.0, "shell", 4)
    with torch.no_grad():
        surface.output_weight[-1] = torch.nan
    occupancy = Occupancy(8)
    assert occupancy.update(surface.at(3), 50.0)
    assert (occupancy.states == SHELL).all()


# --- Adam


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("shape", [(1,), (7, 3), (20_000, 4)])  # the last: more than one task
def test_adam_is_torchs(shape: tuple[int, ...], dtype: torch.dtype, tolerance: float) -> None:
    torch.manual_seed(0)
    ours = torch.randn(shape, dtype=dtype)
    theirs = ours.double().requires_grad_()
    optimiser = torch.optim.Adam([theirs], lr=1.0, betas=(0.9, 0.99), eps=1e-15)
    first, second = torch.zeros_like(ours), torch.zeros_like(ours)
    for count in range(1, 12):
        gradient = torch.randn(shape, dtype=dtype) * 10.0 ** float(torch.randint(-6, 3, ()))
        gradient[torch.rand(shape) < 0.3] = 0  # rows of a table that no sample met
        rate = 0.02 / count
        optimiser.param_groups[0]["lr"] = rate
        theirs.grad = gradient.double()
        optimiser.step()
        kernels.adam(ours, gradient, first, second, kernels.AdamStep(rate, 0.9, 0.99, 1e-15, count))
        assert not gradient.any()
        torch.testing.assert_close(ours.double(), theirs.detach(), atol=tolerance, rtol=0)
    state = optimiser.state[theirs]
    torch.testing.assert_close(first.double(), state["exp_avg"], rtol=10 * tolerance, atol=tolerance * float(first.abs().max()))
    torch.testing.assert_close(second.double(), state["exp_avg_sq"], rtol=10 * tolerance, atol=0)


def test_adam_leaves_what_never_had_a_gradient() -> None:
    for dtype in (torch.float32, torch.float64):
        p, zero = torch.randn(100, dtype=dtype), torch.zeros(100, dtype=dtype)
        before = p.clone()
        for count in (1, 2):
            kernels.adam(p, zero.clone(), first := zero.clone(), second := zero.clone(), kernels.AdamStep(0.1, 0.9, 0.99, 1e-15, count))
        assert torch.equal(p, before) and not first.any() and not second.any()


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 3e-6), (torch.float64, 1e-13)])
@pytest.mark.parametrize("rows", [7, 20_000])
def test_sparse_adam_is_torchs(rows: int, dtype: torch.dtype, tolerance: float) -> None:
    """Rows that a step did not meet stay as they are, and so do their moments."""
    torch.manual_seed(1)
    ours = torch.randn(rows, 4, dtype=dtype)
    theirs = ours.double().requires_grad_()
    optimiser = torch.optim.SparseAdam([theirs], lr=0.02, betas=(0.9, 0.99), eps=1e-15)
    first, second = torch.zeros_like(ours), torch.zeros_like(ours)
    for count in range(1, 12):
        gradient = torch.randn(rows, 4, dtype=dtype) * 10.0 ** float(torch.randint(-6, 3, ()))
        gradient[torch.rand(rows) < 0.7] = 0
        met = torch.nonzero(gradient.any(1))[:, 0]
        before = [x.clone() for x in (ours, first, second)]
        theirs.grad = torch.sparse_coo_tensor(met[None], gradient[met].double(), ours.shape)
        optimiser.step()
        kernels.adam(ours, gradient, first, second, kernels.AdamStep(0.02, 0.9, 0.99, 1e-15, count, sparse=True))
        assert not gradient.any()
        kept = torch.ones(rows, dtype=torch.bool).index_fill(0, met, False)
        assert all(torch.equal(x[kept], old[kept]) for x, old in zip((ours, first, second), before, strict=True))
        torch.testing.assert_close(ours.double(), theirs.detach(), atol=tolerance, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_not_a_number_is_no_gradient_of_zero(dtype: torch.dtype) -> None:
    """Nor is its line of the cache one without gradients; what lies beside it does not move."""
    for at in (21, 49):  # in a whole line, and behind the last of them
        p, gradient, first, second = torch.zeros(4, 50, dtype=dtype)
        gradient[at] = torch.nan
        kernels.adam(p, gradient, first, second, kernels.AdamStep(0.01, 0.9, 0.99, 1e-15, 1, sparse=True))
        for x in (p, first, second):
            assert torch.nonzero(x.isnan())[:, 0].tolist() == [at] and not x.nan_to_num().any()


def test_a_number_met_once_moves_by_about_the_rate() -> None:
    """Its moments would carry it on for ten times as far while other numbers learn."""
    moved = []
    for sparse in (False, True):
        p, first, second = torch.zeros(3, 1)
        for count in range(1, 200):
            gradient = torch.full((1,), 2.5 if count == 50 else 0.0)
            kernels.adam(p, gradient, first, second, kernels.AdamStep(0.01, 0.9, 0.99, 1e-15, count, sparse))
        moved.append(-float(p))
    assert moved[0] > 0.06 and moved[1] == pytest.approx(0.01, rel=0.4)


def test_a_gradient_that_is_not_a_number_is_not_passed_over() -> None:
    for dtype in (torch.float32, torch.float64):
        p, first, second = torch.zeros(3, 5, dtype=dtype)
        gradient = torch.tensor([0.0, float("nan"), 1.0, 0.0, -1.0], dtype=dtype)
        kernels.adam(p, gradient, first, second, kernels.AdamStep(0.01, 0.9, 0.99, 1e-15, 1, sparse=True))
        assert torch.isnan(p).tolist() == [False, True, False, False, False]
