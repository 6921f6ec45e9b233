"""The operations in plain torch, which the fast kernels are measured against: closed forms, gradients, properties."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from torch.nn.functional import normalize, softplus

from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import OUTSIDE, SHELL, SOLID, Rays, Sampling, reference
from mmsynth.field.kernels.shading import HARMONIC_DEGREES, spherical_harmonics
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.rendering import ball_interval
from mmsynth.field.surface import Surface

# dense and hashed levels
RESOLUTIONS, OFFSETS = torch.tensor([2, 3, 9, 40]), torch.tensor([0, 27, 91, 155, 171])


# --- hash grid


@pytest.mark.parametrize("active", [1, 2, 4])
def test_hash_encode_gradients(active: int) -> None:
    torch.manual_seed(0)
    table = torch.randn(171, 4, dtype=torch.float64, requires_grad=True)
    positions = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p, t: reference.hash_encode(p, t, RESOLUTIONS, OFFSETS, active), (positions, table))


def test_inactive_levels_are_zero_and_the_others_do_not_change() -> None:
    table, positions = torch.randn(171, 4, dtype=torch.float64), torch.rand(50, 3, dtype=torch.float64)
    whole = reference.hash_encode(positions, table, RESOLUTIONS, OFFSETS, 4)
    for active in range(4):
        part = reference.hash_encode(positions, table, RESOLUTIONS, OFFSETS, active)
        assert torch.equal(part[:, : 4 * active], whole[:, : 4 * active]) and not part[:, 4 * active :].any()
    assert torch.equal(reference.hash_encode(positions, table, RESOLUTIONS, OFFSETS, 9), whole)


def test_dense_level_is_trilinear_interpolation() -> None:
    from scipy.interpolate import RegularGridInterpolator

    n = 4
    values = np.random.default_rng(0).normal(size=(n + 1, n + 1, n + 1, 4))
    points = np.concatenate([np.random.default_rng(1).random((50, 3)), [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.25, 1.0, 0.0]]])
    expected = RegularGridInterpolator((np.arange(n + 1) / n,) * 3, values)(points)
    table = torch.from_numpy(values.reshape(-1, 4))
    found = reference.hash_encode(torch.from_numpy(points), table, torch.tensor([n]), torch.tensor([0, (n + 1) ** 3]), 1)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_places_outside_the_cube_see_its_border(extent: float) -> None:
    grid = HashGrid(2, 9, 4, 9, extent).double()
    inside = extent * torch.tensor([[1.0, 0.3, -1.0], [-1.0, 1.0, 1.0]], dtype=torch.float64)
    outside = extent * torch.tensor([[1.7, 0.3, -4.0], [-1.1, 9.0, 2.0]], dtype=torch.float64)
    assert torch.equal(grid(outside, 2), grid(inside, 2))


def test_grid_rows_and_cells() -> None:
    grid = HashGrid(4, 10, 4, 108)
    assert grid.resolutions.tolist() == [4, 12, 36, 108] and grid.offsets.diff().tolist() == [125, 1024, 1024, 1024]
    assert grid.cell(1) == 0.5 and grid.cell(4) == grid.cell(9) == pytest.approx(2 / 108)
    assert HashGrid(4, 10, 4, 108, extent=2.0).cell(4) == pytest.approx(4 / 108)
    assert HashGrid(1, 8, 4, 100).resolutions.tolist() == [4]


def test_harmonics_are_orthonormal_and_in_the_order_of_their_degrees() -> None:
    """Gauss' quadrature in z, equal angles around it: exact for these polynomials."""
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = 2 * np.pi * np.arange(16) / 16
    ring = np.sqrt(1 - z**2)[:, None]
    d = np.stack([ring * np.cos(angle), ring * np.sin(angle), np.broadcast_to(z[:, None], (8, 16))], -1).reshape(-1, 3)
    y = spherical_harmonics(torch.from_numpy(d)).numpy()
    np.testing.assert_allclose((y * np.repeat(weight, 16)[:, None] * 2 * np.pi / 16).T @ y, np.eye(16), atol=1e-12)
    # a harmonic of degree l turns with the sphere into harmonics of degree l alone
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    mixed = np.linalg.lstsq(y, spherical_harmonics(torch.from_numpy(d @ turn.T)).numpy(), rcond=None)[0]
    degree = np.repeat(np.arange(4), 2 * np.arange(4) + 1)
    assert np.abs(mixed[degree[:, None] != degree]).max() < 1e-12
    assert HARMONIC_DEGREES.tolist() == degree.tolist()


# --- surface


@pytest.mark.parametrize(("extent", "active"), [(1.0, 1), (1.0, 3), (2.0, 3)])
def test_surface_gradients(extent: float, active: int) -> None:
    torch.manual_seed(1)
    surface = Surface(HashGrid(3, 6, 2, 11, extent), 4, (0.5, 1.9 if extent > 1 else 1e9)).double()
    positions = ((torch.rand(5, 3, dtype=torch.float64) * 2 - 1) * extent).requires_grad_()
    hidden, last = (torch.randn_like(p).requires_grad_() for p in (surface.hidden, surface.output_weight))
    table = torch.randn_like(surface.grid.table).requires_grad_()

    def value(positions: torch.Tensor, *parameters: torch.Tensor) -> torch.Tensor:
        names = ("hidden", "last", "grid.table")
        return torch.func.functional_call(surface, dict(zip(names, parameters, strict=True)), (positions, active))

    assert torch.autograd.gradcheck(value, (positions, hidden, last, table))


def test_a_new_surface_is_a_sphere_within_a_sphere() -> None:
    surface = Surface(HashGrid(3, 8, 3, 11, 2.0), 8, (0.5, 1.9))
    x = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.4, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.95]])
    for value in (surface(x, 3), reference.surface_value(x, *surface.at(3))):
        torch.testing.assert_close(value, torch.tensor([-0.5, 0.0, 0.5, -0.05]), atol=1e-6, rtol=0)


def test_gradient_by_four_taps_is_exact_for_linear_functions_and_true_for_a_sphere() -> None:
    surface = Surface(HashGrid(1, 8, 3, 3), 4, (0.5, 1e9)).double()
    with torch.no_grad():
        surface.hidden[0] = torch.tensor([0.3, -2.0, 1.0, 5.0, 0, 0, 0, 0])
        surface.output_weight[0] = 1.0
    x = normalize(torch.randn(20, 3, dtype=torch.float64), dim=1) * 0.7
    expected = torch.tensor([0.3, -2.0, 1.0]) + x / 0.7
    for epsilon in (1e-3, 1e-6):  # the error is the curvature, 1 / 0.7, times the size of the taps
        torch.testing.assert_close(surface.gradient(x, epsilon, 1), expected.double(), atol=epsilon / 0.7, rtol=0)


# --- contraction

far_away = st.floats(-1e6, 1e6, allow_subnormal=False)
unit = hnp.arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: v / np.linalg.norm(v))


@settings(deadline=None)
@given(hnp.arrays(np.float64, 3, elements=far_away))
def test_contraction_is_the_published_one(point: np.ndarray) -> None:
    r = np.linalg.norm(point)
    expected = point if r <= 1 else (2 - 1 / r) * point / r
    found = reference.contract(torch.from_numpy(point)[None])[0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-15, rtol=1e-15)
    assert np.linalg.norm(found) < 2


@settings(deadline=None)
@given(unit, st.floats(-1e-3, 1e-3))
def test_contraction_is_smooth_at_the_unit_sphere(direction: np.ndarray, step: float) -> None:
    """Value and slope go over into each other: 2 - 1/(1 + h) = 1 + h - h²."""
    found = reference.contract(torch.from_numpy((1 + step) * direction)[None])[0].numpy()
    np.testing.assert_allclose(found, (1 + step) * direction, atol=1.01 * step**2 + 1e-15)


@settings(deadline=None)
@given(unit, unit, st.floats(0.01, 50))
def test_contracted_velocity_is_a_finite_difference(place: np.ndarray, direction: np.ndarray, radius: float) -> None:
    x, d = torch.from_numpy(radius * place)[None], torch.from_numpy(direction)[None]
    h = 1e-6
    expected = (reference.contract(x + h * d) - reference.contract(x - h * d)) / (2 * h)
    torch.testing.assert_close(reference.contracted_velocity(x, d), expected, atol=3e-6, rtol=0)  # the slope has a kink at radius 1
    (slope,) = torch.autograd.functional.jvp(reference.contract, x, d)[1:]
    torch.testing.assert_close(reference.contracted_velocity(x, d), slope, atol=1e-12, rtol=0)


# --- sums and weights of packed samples


@settings(deadline=None)
@given(st.lists(st.integers(0, 9), min_size=1, max_size=8))
def test_exclusive_sum_is_a_sum_per_ray(counts: list[int]) -> None:
    ray = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    offsets = torch.tensor([0, *counts]).cumsum(0)
    values = torch.randn(sum(counts), dtype=torch.float64)
    expected = [sum(values[offsets[r] : i].tolist()) for i, r in enumerate(ray.tolist())]
    torch.testing.assert_close(reference.exclusive_sum(values, offsets, ray), torch.tensor(expected, dtype=torch.float64))


def test_section_weights_gradients() -> None:
    """Rays with many samples, none, one and two."""
    offsets = torch.tensor([0, 4, 4, 5, 7, 12])
    sdf = torch.linspace(0.2, -0.2, 12, dtype=torch.float64).roll(3).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: reference.section_weights(f, 20.0, offsets)[0], sdf)


def test_section_weights_are_the_formula() -> None:
    torch.manual_seed(2)
    counts, s = [5, 0, 1, 34, 60], 30.0
    offsets = torch.tensor([0, *counts]).cumsum(0)
    sdf = torch.randn(100, dtype=torch.float64) * 0.1
    weights, crossing = reference.section_weights(sdf, s, offsets)
    logistic = lambda f: 1 / (1 + np.exp(-s * f))
    for begin, end in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True):
        left = 1.0
        for i in range(begin, end):
            if i == end - 1:
                assert weights[i] == 0
                continue
            f0, f1 = float(sdf[i]), float(sdf[i + 1])
            behind = i == begin and f0 < 0  # a ray comes from the open: then from the surface
            alpha = max((0.5 - logistic(min(f0, f1))) / 0.5 if behind else (logistic(f0) - logistic(f1)) / logistic(f0), 0.0)
            assert float(weights[i]) == pytest.approx(left * alpha, abs=1e-9)
            left *= 1 - alpha
            assert float(crossing[i]) == pytest.approx(f0 / (f0 - f1) if f0 > 0 >= f1 else 0.5 * (not behind), abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.floats(1.0, 2000.0), st.floats(-0.5, 0.5), st.integers(2, 60))
def test_falling_sdf_has_the_closed_form_opacity(sharpness: float, end: float, count: int) -> None:
    """Along a monotonically falling sdf the opacity telescopes to 1 - Φ(s f_end) / Φ(s f_start), however it is cut."""
    sdf = torch.linspace(0.6, end, count)
    weights, _ = reference.section_weights(sdf, sharpness, torch.tensor([0, count]))
    logistic = lambda f: 1.0 / (1.0 + np.exp(-np.clip(sharpness * f, -700, 700)))
    assert float(weights.sum()) == pytest.approx(1 - logistic(float(sdf[-1])) / logistic(float(sdf[0])), abs=2e-5)


# --- marching

SHARPNESS, STEP, OPAQUE = 200.0, 0.01, 3.0
SAMPLING = Sampling(SHARPNESS, STEP, 1, 1, max_optical_depth=OPAQUE)
Distance = Callable[[torch.Tensor], torch.Tensor]


def sphere(x: torch.Tensor) -> torch.Tensor:
    return x.norm(dim=-1) - 0.5


def room(x: torch.Tensor) -> torch.Tensor:
    """The sphere and, in contracted space, a wall around everything."""
    return torch.minimum(x.norm(dim=-1) - 0.5, 1.9 - x.norm(dim=-1))


def _march(sdf: Distance, extent: float, classified: bool, jitter: float) -> tuple[torch.Tensor, ...]:
    """Rays from around and from within, and their samples per ray, padded with NaN."""
    generator = torch.Generator().manual_seed(3)
    aim = torch.randn(120, 3, generator=generator, dtype=torch.float64)
    origins = normalize(torch.randn(120, 3, generator=generator, dtype=torch.float64), dim=1) * 2.4
    origins[:20] *= 0.3
    directions = normalize(0.45 * aim - origins, dim=1)
    near, far = ball_interval(origins, directions) if extent == 1 else (torch.zeros(120).double(), torch.full((120,), 1e3).double())
    occupancy = Occupancy(32, extent)
    if classified:
        occupancy.update(sdf, SHARPNESS)
        assert (occupancy.states == SHELL).any() and (occupancy.states >= OUTSIDE).float().mean() > 0.3
    t, ray, offsets = reference.march(
        sdf, Rays(origins, directions, near, far, torch.full((120,), jitter).double()), occupancy.states, extent, SAMPLING
    )
    assert torch.equal(ray, torch.repeat_interleave(torch.arange(120), offsets.diff())) and len(t) == offsets[-1]
    padded = torch.full((120, int(offsets.diff().max())), torch.nan, dtype=torch.float64)
    padded[ray, torch.arange(len(t)) - offsets[ray]] = t
    return origins, directions, near, far, padded, occupancy.states


@pytest.mark.parametrize("jitter", [0.0, 0.7])
@pytest.mark.parametrize("classified", [False, True])
@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_samples_lie_around_where_a_ray_meets_a_surface(extent: float, classified: bool, jitter: float) -> None:
    sdf = sphere if extent == 1 else room
    origins, directions, near, far, t, _ = _march(sdf, extent, classified, jitter)
    b = (origins * directions).sum(1)
    root = b * b - (origins * origins).sum(1) + 0.25
    meets = (root > 0.02) & (-b - root.clamp(min=0).sqrt() > 0)
    exact = -b - root.clamp(min=0).sqrt()
    if extent > 1:  # else the wall, at contracted radius 1.9
        wall = -b + (b * b - (origins * origins).sum(1) + 100.0).sqrt()
        misses = root < -0.02
        exact, meets = torch.where(misses, wall, exact), meets | misses
    assert meets.sum() > 40
    place = origins[:, None] + directions[:, None] * t.nan_to_num()[..., None]
    f = sdf(reference.contract(place) if extent > 1 else place)
    exists = ~t.isnan()
    assert ((t >= near[:, None]) & (t < far[:, None]))[exists].all() and (t.diff(dim=1)[exists[:, 1:]] > 0).all()
    for i in torch.nonzero(meets)[:, 0].tolist():
        fi, ti = f[i][exists[i]], t[i][exists[i]]
        (cross,) = torch.nonzero((fi[:-1] > 0) & (fi[1:] <= 0))
        assert len(cross) == 1
        assert ti[cross] <= exact[i] + 1e-9 and ti[cross + 1] >= exact[i] - 1e-9
        # it is met with the step, and the ray ends at the optical depth that is opaque
        assert float(fi[cross] - fi[cross + 1]) < 1.3 * STEP
        tau = softplus(-SHARPNESS * fi[1:]) - softplus(-SHARPNESS * fi[:-1])
        depth = tau.clamp(min=0).cumsum(0)
        assert depth[-1] > OPAQUE or (classified and fi[-1] < 0)
        assert (depth[:-1] <= OPAQUE).all()


@pytest.mark.parametrize("extent", [1.0, 2.0])
def test_no_sample_is_in_a_free_cell(extent: float) -> None:
    for jitter in (0.0, 0.9):
        origins, directions, _, _, t, states = _march(sphere if extent == 1 else room, extent, True, jitter)
        exists, o, d = ~t.isnan(), origins[:, None].expand(*t.shape, 3), directions[:, None].expand(*t.shape, 3)
        speed = torch.ones_like(t)
        if extent > 1:
            speed = reference.contracted_velocity(o + d * t.nan_to_num()[..., None], d).norm(dim=-1)
        free = []
        # samples enter a shell by up to a step, and a corner of one may be shorter than that
        for at in (t.nan_to_num(), t.nan_to_num() - 1.1 * jitter * STEP / speed):
            x = o + d * at[..., None]
            i, j, k = (((reference.contract(x) if extent > 1 else x) + extent) * (16 / extent)).long().clamp(0, 31).unbind(-1)
            free.append(exists & (states[i, j, k] >= OUTSIDE))
        assert not (free[0] & free[1]).any() and free[0].sum() < 0.1 * exists.sum()
        assert jitter > 0 or not free[0].any()


def test_free_rays_end_with_few_samples_or_none() -> None:
    _, _, near, far, t, _ = _march(sphere, 1.0, False, 0.3)
    assert (far == near).any() and t[far == near].isnan().all()
    rays = torch.zeros(4, 3, dtype=torch.float64) - 0.9, torch.eye(4, 3, dtype=torch.float64) + torch.tensor([0, 0, 1e-3])
    near, far, jitter = torch.zeros(4).double(), torch.full((4,), 1.8).double(), torch.zeros(4).double()
    free = torch.full((8, 8, 8), OUTSIDE, dtype=torch.uint8)
    for value in (OUTSIDE, OUTSIDE + 1, 253):
        t, ray, offsets = reference.march(sphere, Rays(*rays, near, far, jitter), free.fill_(value), 1.0, SAMPLING)
        assert len(t) == len(ray) == 0 and offsets.tolist() == [0] * 5


def test_certified_distance_is_gone_at_once() -> None:
    """One cell certifies what lies ahead: the ray is past a shell that contradicts it."""
    states = torch.full((8, 8, 8), OUTSIDE, dtype=torch.uint8)
    states[2:4] = SHELL
    ray = torch.tensor([[-0.9, 0.1, 0.1]]).double(), torch.tensor([[1.0, 0.0, 0.0]]).double()
    rest = torch.zeros(1).double(), torch.full((1,), 1.8).double(), torch.zeros(1).double()
    away = lambda x: torch.full_like(x[:, 0], 0.2)
    t, _, _ = reference.march(away, Rays(*ray, *rest), states, 1.0, SAMPLING)
    assert len(t) and t[0] == pytest.approx(0.4, abs=0.2 * STEP)
    states[0] = OUTSIDE + 8  # half cells: up to x = 0.1
    assert len(reference.march(away, Rays(*ray, *rest), states, 1.0, SAMPLING)[0]) == 0


def test_a_ray_ends_at_its_second_sample_in_a_solid_cell() -> None:
    states = torch.full((8, 8, 8), SOLID, dtype=torch.uint8)
    ray = torch.tensor([[-0.9, 0.1, 0.1]]).double(), torch.tensor([[1.0, 0.0, 0.0]]).double()
    rest = torch.zeros(1).double(), torch.full((1,), 1.8).double(), torch.zeros(1).double()
    t, _, _ = reference.march(lambda x: torch.full_like(x[:, 0], 0.2), Rays(*ray, *rest), states, 1.0, SAMPLING)
    assert len(t) == 2
    states[:4] = SHELL  # the first solid cell begins at x = 0
    t, _, _ = reference.march(lambda x: torch.full_like(x[:, 0], 0.0), Rays(*ray, *rest), states, 1.0, SAMPLING)
    assert 0.9 <= t[-1] <= 0.9 + STEP / SAMPLING.min_slope and (t[:-1] < 0.9).all()


def test_no_ray_takes_more_than_the_most_samples() -> None:
    ray = torch.tensor([[-0.9, 0.1, 0.1]]).double(), torch.tensor([[1.0, 0.0, 0.0]]).double()
    rest = torch.zeros(1).double(), torch.full((1,), 1.8).double(), torch.zeros(1).double()
    small = Sampling(SHARPNESS, 1e-3, 1, 1)
    t, _, _ = reference.march(lambda x: 0 * x[:, 0], Rays(*ray, *rest), torch.zeros(8, 8, 8, dtype=torch.uint8), 1.0, small)
    assert len(t) == reference.MAX_SAMPLES_PER_RAY
    # a distance that does not fall is stepped over with the least slope; which halves with each sixth of the samples after the second
    spent = torch.arange(1, 95) // 16
    torch.testing.assert_close(t.diff()[1:], 2e-3 * 2.0 ** (spent - 1).clamp(min=0).double())


# --- occupancy


@pytest.mark.parametrize("extent", [1.0, 2.0])
@pytest.mark.parametrize("sharpness", [20.0, 1000.0])
def test_states_are_true_of_every_point_of_a_cell(extent: float, sharpness: float) -> None:
    sdf = sphere if extent == 1 else room
    grid = 24
    occupancy = Occupancy(grid, extent)
    assert occupancy.update(sdf, sharpness)
    corners = torch.rand(grid, grid, grid, 40, 3, generator=torch.Generator().manual_seed(1))
    index = torch.stack(torch.meshgrid(*[torch.arange(grid)] * 3, indexing="ij"), -1)
    x = ((index[..., None, :] + corners) * (2 / grid) - 1) * extent
    value, state = sdf(x), occupancy.states[..., None].expand(x.shape[:-1])
    assert set(range(OUTSIDE + 1)) <= set(state.unique().tolist()) or sharpness == 20.0
    assert (value[state >= OUTSIDE] > 5 / sharpness).all() and (value[state == SOLID] < -5 / sharpness).all()
    # what is certified to be free around the cell
    half_cell = extent / grid
    assert ((state.long() - OUTSIDE) * half_cell < value + 1e-6)[state >= OUTSIDE].all()
