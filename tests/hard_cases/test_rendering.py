"""Numerical hard cases of volume rendering an SDF: what the usual formula does, and the bound that ours keeps."""

import numpy as np
import pytest
import torch

from mmsynth.field import kernels
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import OUTSIDE, SHELL, cpu
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.rendering import Sampling, ball_interval, median_depth, trace
from mmsynth.field.surface import Surface


def neus_weights(sdf: torch.Tensor, s: float) -> torch.Tensor:
    """The published form (Wang et al. 2021, code): α = (Φ(f₀) - Φ(f₁) + 1e-5) / (Φ(f₀) + 1e-5), Π(1 - α + 1e-7)."""
    a, b = torch.sigmoid(s * sdf[:-1]), torch.sigmoid(s * sdf[1:])
    alpha = ((a - b + 1e-5) / (a + 1e-5)).clamp(0, 1)
    return alpha * torch.cumprod(torch.cat([torch.ones(1), 1 - alpha + 1e-7]), 0)[:-1]


def ours(sdf: torch.Tensor, s: float) -> torch.Tensor:
    return cpu.section_weights(sdf, s, torch.tensor([0, len(sdf)]))[0]


def test_empty_space_haze() -> None:
    sdf = torch.full((1025,), 0.3)
    assert neus_weights(sdf, 512.0).sum() > 0.009
    assert ours(sdf, 512.0).sum() == 0.0


def test_deep_inside() -> None:
    """Falling through the inside of an object at f = -0.05: the exact opacity of a section is 0.641."""
    sdf = torch.tensor([-0.05, -0.052])
    exact = 1 - np.exp(-512 * 0.002)
    assert neus_weights(sdf, 512.0)[0] > 0.99
    assert float(ours(sdf, 512.0)[0]) == pytest.approx(exact, abs=1e-5)


@pytest.mark.parametrize("s", [1.0, 1e3, 1e6])
def test_any_sharpness_is_finite_and_sums_to_at_most_one(s: float) -> None:
    sdf = torch.linspace(1.0, -1.0, 777).requires_grad_()
    weights = ours(sdf, s)
    weights.square().sum().backward()
    assert torch.isfinite(weights).all() and torch.isfinite(sdf.grad).all()
    assert float(weights.detach().double().sum()) <= 1 + 1e-6
    expected = 1 - (1 / (1 + np.exp(s))) / (1 / (1 + np.exp(-s))) if s < 100 else 1.0
    assert float(weights.detach().sum()) == pytest.approx(expected, abs=1e-5)


def test_opaque_section_does_not_divide_by_zero() -> None:
    """α = 1 exactly, then more samples: cumprod needs an epsilon, exp(-Σ) does not."""
    sdf = torch.tensor([1.0, -1.0, -2.0, 1.0, -1.0]).requires_grad_()
    weights = ours(sdf, 1e4)
    weights.sum().backward()
    assert weights.tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]
    assert torch.isfinite(sdf.grad).all()


def _parts(radius: float = 0.5) -> tuple[Surface, HashGrid, Occupancy]:
    return Surface(HashGrid(2, 8, 4, 8), 4, radius), HashGrid(2, 8, 4, 8), Occupancy(16)


SAMPLING = Sampling(sharpness=400.0, step=0.005, active_surface=2, active_radiance=2, active_background=0)


def _depth(origins: torch.Tensor, directions: torch.Tensor, radius: float = 0.5) -> torch.Tensor:
    hits = trace(*_parts(radius), origins, directions, torch.full((len(origins),), 0.5), SAMPLING)
    return median_depth(hits, len(origins))


def test_depth_of_a_sphere_is_exact() -> None:
    """The surface is where the section crosses it: no bias by half a step."""
    directions = torch.nn.functional.normalize(torch.tensor([[0.0, 0.0, 1.0], [0.05, 0.1, 1.0], [-0.1, 0.08, 1.0]]), dim=1)
    origins = torch.tensor([[0.0, 0.0, -3.0]]).expand(3, 3)
    b = (origins * directions).sum(1)
    exact = -b - torch.sqrt(b * b - 9.0 + 0.25)
    torch.testing.assert_close(_depth(origins, directions), exact, atol=2e-4, rtol=0)


def test_camera_inside_the_region_and_zero_samples() -> None:
    origins = torch.tensor([[0.0, 0.0, -0.8], [0.0, 0.0, -0.8], [0.0, 0.0, 5.0], [3.0, 0.0, 0.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    depth = _depth(origins, directions)
    assert float(depth[0]) == pytest.approx(0.3, abs=1e-3)
    assert torch.isnan(depth[1:]).all()
    assert torch.isnan(_depth(origins[2:], directions[2:])).all()  # not one sample in the whole batch


def test_rays_in_a_face_of_a_grid_cell_are_finite() -> None:
    """Axis-parallel rays exactly in cell faces: the slab test's 0 / 0."""
    occupancy = Occupancy(8)
    occupancy.states[:, :, 4:] = OUTSIDE
    origins = torch.tensor([[-2.0, 0.25, -0.25], [-2.0, 0.0, 0.0], [-2.0, -0.5, 0.25]])
    directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3)
    near, far = ball_interval(origins, directions)
    t, _, offsets = kernels.march(origins, directions, near, far, torch.zeros(3), occupancy.states, 0.01)
    assert torch.isfinite(t).all() and offsets.diff()[0] > 100 and offsets.diff()[1:].tolist() == [0, 0]


def test_ball_interval_of_tangent_and_receding_rays() -> None:
    origins = torch.tensor([[-2.0, 1.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-1e4, 0.5, 0.0]])
    directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(4, 3)
    near, far = ball_interval(origins, directions)
    assert far[0] == pytest.approx(float(near[0]), abs=1e-3) and far[1] == near[1]
    assert near[2] == 0 and far[2] == 1
    # a camera 10,000 radii away: |o|² - (o·d)² in float32 would lose the chord entirely
    assert float(far[3] - near[3]) == pytest.approx(2 * np.sqrt(0.75), abs=5e-3)


def test_an_empty_occupancy_grid_reopens() -> None:
    occupancy = Occupancy(8)
    generator = torch.Generator().manual_seed(0)
    assert not occupancy.update(lambda x: torch.full((len(x),), 5.0), 100.0, generator, 1.0)
    assert (occupancy.states == SHELL).all()


def test_a_pruned_cell_comes_back() -> None:
    occupancy = Occupancy(8)
    generator = torch.Generator().manual_seed(0)
    occupancy.update(lambda x: x[:, 0] + 0.9, 500.0, generator, 1.0)
    assert (occupancy.states[7] == OUTSIDE).all()
    for _ in range(100):
        occupancy.update(lambda x: x[:, 0] - 0.9, 500.0, generator, 1 / 16)
    assert (occupancy.states[7] == SHELL).any()


def test_occupancy_loses_no_surface() -> None:
    surface, appearance, occupancy = _parts()
    rays = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    jitter = torch.full((200,), 0.5)
    full = trace(surface, appearance, occupancy, -3 * rays, rays, jitter, SAMPLING)
    occupancy.update(lambda x: surface(x, 2), SAMPLING.sharpness, torch.Generator().manual_seed(0), 1.0)
    pruned = trace(surface, appearance, occupancy, -3 * rays, rays, jitter, SAMPLING)
    assert len(pruned.t) < 0.4 * len(full.t)
    torch.testing.assert_close(pruned.opacity, full.opacity, atol=1e-3, rtol=0)


def test_one_hash_level() -> None:
    grid = HashGrid(1, 8, 4, 100)
    assert torch.isfinite(grid(torch.rand(5, 3), 1)).all() and grid.resolutions.tolist() == [4]
