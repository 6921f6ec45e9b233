"""What a step on the device has around ``learn``: against the same in torch."""

import pytest
import torch
from torch.nn.functional import normalize

from mmsynth.field import kernels, rendering
from mmsynth.field.kernels.cuda import stepping
from mmsynth.field.kernels.cuda.drawing import begins_of

COUNTS, VALUES, OUTSIDE = [40, 3, 30], [1, 3, 4], 9
RAYS = sum(COUNTS)
BOUNDS = rendering.NEAR, rendering.FREE, rendering.FARTHEST


def _drawn(device: str) -> tuple[kernels.Drawn, stepping.Tables, list[torch.Tensor]]:
    begins = begins_of(VALUES, [False, False, True], COUNTS)
    numbers = begins[1][-1]
    ray = torch.cat([torch.arange(b, b + c).repeat_interleave(v) for b, c, v in zip(begins[0], COUNTS, VALUES, strict=False)])
    alpha = torch.where(torch.rand(RAYS) < 0.5, torch.rand(RAYS), torch.nan)
    level = torch.tensor([0.5, 1.0, 2.0])[torch.tensor([0, 1, 2]).repeat_interleave(torch.tensor(COUNTS))][ray]
    target = torch.rand(numbers) * (torch.rand(RAYS) < 0.5)[ray]
    zero = torch.zeros(numbers)
    measured = kernels.Measured(target, ray, ray, torch.zeros(begins[2][-1], 3), level, zero, zero)
    origins = normalize(torch.randn(RAYS + OUTSIDE, 3), dim=1) * (0.3 + 3.0 * torch.rand(RAYS + OUTSIDE, 1))
    directions = normalize(0.4 * torch.randn(RAYS + OUTSIDE, 3) - origins, dim=1)
    tiles = torch.randperm(200)[:RAYS]
    drawn = kernels.Drawn(origins[:RAYS], directions[:RAYS], alpha, alpha, torch.rand(RAYS), tiles, ray, measured)
    drawn = kernels.Drawn(*(x.to(device) for x in drawn[:-1]), kernels.Measured(*(x.to(device) for x in measured)))
    whole = lambda values: torch.tensor(values, dtype=torch.int32, device=device)
    tables = stepping.Tables(whole(VALUES), whole([0, 3, 2]), whole([1, 0, 1]), torch.tensor(begins, device=device))
    return drawn, tables, [origins.to(device), directions.to(device), torch.zeros(RAYS + OUTSIDE, device=device)]


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("black", [False, True])
def test_what_is_known_of_rays(device: str, contracted: bool, black: bool) -> None:
    drawn, tables, ends = _drawn(device)
    known = stepping.Known(0.3, 0.7, 0.2, 0.15, 0.4, 0.05, True, black)
    rays, view, opacities = stepping.aim(drawn, *ends, tables, known, BOUNDS, contracted)
    origins, directions = ends[:2]
    if contracted:
        near = (rendering.FREE * (origins.norm(dim=1) - 1.0)).clamp(min=rendering.NEAR)
        far = torch.full_like(near, rendering.FARTHEST)
    else:
        near, far = rendering.ball_interval(origins, directions)
    torch.testing.assert_close(rays.near, near, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(rays.far, far, atol=1e-5, rtol=1e-5)
    of = torch.tensor([0, 1, 2]).repeat_interleave(torch.tensor(COUNTS)).to(device)
    assert torch.equal(view.degrees, torch.cat([torch.tensor([0, 3, 2], device=device)[of], of.new_zeros(OUTSIDE)]))
    assert torch.equal(view.trains_geometry, torch.cat([of != 1, of.new_ones(OUTSIDE).bool()]))
    stated = torch.isfinite(drawn.alpha)
    weight = torch.zeros_like(drawn.alpha) if black else 0.3 * drawn.ray_weight * stated
    torch.testing.assert_close(opacities.weight, torch.cat([weight, weight.new_full((OUTSIDE,), 0.7)]))
    torch.testing.assert_close(opacities.target[:RAYS], torch.where(stated, drawn.alpha, 0.0))
    nothing = torch.zeros_like(drawn.alpha) if black else 0.15 * drawn.ray_weight * (drawn.alpha == 0.0)
    torch.testing.assert_close(opacities.blocked, torch.cat([nothing, nothing.new_full((OUTSIDE,), 0.4)]))
    m = drawn.measured
    dark = torch.zeros(RAYS, device=device).scatter_reduce(0, m.ray, m.target / m.level, "amax") < 0.02
    torch.testing.assert_close(opacities.linear[:RAYS], 0.2 * drawn.ray_weight * dark * black)
    assert not opacities.linear[RAYS:].any() and bool(dark.any()) and not bool(dark.all())


def test_points_are_even_and_noise_is_normal(device: str) -> None:
    numbers = stepping.new_numbers(torch.device(device))
    stepping.set_numbers(numbers, 60.0, 0.03, 0.5, (0.25, 0.75), (0.5, 0.25, 0.75), (1, 2**32 - 1, 3, 4))
    assert float(numbers.sharpness) == 60.0 and numbers.factors.tolist() == [0.5, 0.125, 0.375]
    assert numbers.beta2.tolist() == [0.5, 0.25, 0.75]
    assert float(numbers.step) == pytest.approx(0.03) and [x % 2**32 for x in numbers.key.tolist()] == [1, 2**32 - 1, 3, 4]
    points, noise, aside = stepping.random_points(numbers, (3000, 4000, 3500), 2.0, 3.0, (0.2, 0.4))
    assert float(points.abs().max()) <= 2.0 and float((points.mean(0)).abs().max()) < 0.1
    torch.testing.assert_close(points.std(0).cpu(), torch.full((3,), 2.0 / 3**0.5), atol=0.05, rtol=0)
    torch.testing.assert_close(noise.std(0).cpu(), torch.full((3,), 3.0 / 60.0), atol=0.003, rtol=0)
    assert float(torch.corrcoef(noise.T).fill_diagonal_(0.0).abs().max()) < 0.06
    assert float((noise / 0.05).pow(4).mean()) == pytest.approx(3.0, abs=0.3)
    length = torch.linalg.vector_norm(aside, dim=-1, keepdim=True)
    assert 0.199 < float(length.min()) < 0.202 and 0.398 < float(length.max()) < 0.401
    torch.testing.assert_close((aside / length).pow(2).mean(0).cpu(), torch.full((3,), 1 / 3), atol=0.02, rtol=0)
    assert float((aside / length).mean(0).abs().max()) < 0.04 and float(length.mean()) == pytest.approx(0.3, abs=0.004)


@pytest.mark.parametrize("good", [True, False])
def test_a_good_step_tells_where_errors_are(device: str, good: bool) -> None:
    drawn, tables, _ = _drawn(device)
    squared, residual = torch.rand(len(drawn.frame), device=device), torch.ones(200, device=device)
    errors, steps = torch.ones(3, dtype=torch.float64, device=device), torch.tensor([good, 5], dtype=torch.int32, device=device)
    stepping.tally(drawn, squared, tables, steps, residual, errors, 0.8)
    if not good:
        assert torch.equal(errors.cpu(), torch.ones(3).double()) and bool((residual == 1.0).all())
        return
    expected, begin = torch.ones(200, device=device), 0
    for n, (part, values) in enumerate(zip(squared.split([c * v for c, v in zip(COUNTS, VALUES, strict=True)]), VALUES, strict=True)):
        own, mean = slice(begin, begin + COUNTS[n]), part.view(-1, values).mean(1)
        begin += COUNTS[n]
        assert float(errors[n]) == pytest.approx(1.0 + float((drawn.ray_weight[own] * mean).mean()), rel=1e-5)
        expected[drawn.tile[own]] = 0.8 + 0.2 * mean.sqrt() / [0.5, 1.0, 2.0][n]
    torch.testing.assert_close(residual, expected)
