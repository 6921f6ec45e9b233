"""A step of a fit: the loss of what was measured along rays, and its gradients, in plain torch: with ``reference`` the definition."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor
from torch.nn.functional import linear, normalize

from mmsynth.field.kernels import reference
from mmsynth.field.kernels.constants import LEAST_WEIGHT, MOSTLY_BLOCKED, RAYS_OF_PAIR, SOFT_EDGE
from mmsynth.field.kernels.parameters import (
    Eikonal,
    GridTable,
    Hits,
    Lamps,
    Learned,
    LightNetwork,
    Mirrors,
    Rays,
    ShadedRays,
    Smooth,
    Step,
    SurfaceNetwork,
    View,
)
from mmsynth.field.kernels.shading import rays_of

Evaluation = Callable[[Tensor, GridTable, SurfaceNetwork], Tensor]  # see ``reference.surface_value``
# corners of a regular tetrahedron: the four taps of a first derivative, its trace exact for linear functions
TAPS = ((1.0, -1.0, -1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, 1.0, 1.0))


def gradient_of(tensor: Tensor) -> Tensor:
    """Its ``grad``, zeros if it had none."""
    if tensor.grad is None:
        tensor.grad = torch.zeros_like(tensor)
    return tensor.grad


def no_light(device: torch.device | str) -> LightNetwork:
    """Of a field in which nothing shines."""
    empty = lambda *shape: torch.empty(shape, device=device)
    none = torch.empty(0, dtype=torch.int64, device=device)
    return LightNetwork(empty(0, 0), empty(0), empty(0, 0), empty(0), empty(0, 3), empty(0, 0), none)


def learn(step: Step) -> Learned:
    """The loss of R rays, and its gradients, which are added to ``grad`` of all tables, weights, lamps and gains.

    It is the photometric loss (see ``compare``), ``Opacities``, ``Eikonal`` and ``Smooth``.
    """
    grid, network, appearance, states, shader, light, far_light, rays, view, measured, gains, opacities, eikonal, smooth, sampling, _ = step
    count = len(rays.origins)
    hits = reference.trace(grid, network, appearance, states, rays, sampling)
    ray = rays_of(hits.behind, len(hits.share))
    gain = torch.exp(gains.log_gain - gains.log_gain.mean())[gains.frame] if len(gains.log_gain) else None
    mirrored, slopes, shallow = None, *_at_points(hits, grid, network, rays, eikonal)
    if len(light.used):
        lamps, mirrors, met = _mirrors(hits, ray, grid, network, light, rays, view, eikonal)
        mirrored = reference.mirror(lamps, mirrors, hits.behind, measured)
        slopes = torch.cat([slopes, met])
        shallow = torch.cat([shallow, torch.ones_like(met[:, 0])])
    shaded = with_far_light(hits, far_light)
    seen = ShadedRays(shaded.features, shaded.share, shaded.behind, rays.directions, view.degrees, view.trains_geometry)
    loss, squared = reference.compare(shader, seen, measured, gain, mirrored)
    if len(opacities.target):
        o = opacities
        loss = loss + (o.weight * (hits.opacity - o.target).square() + o.linear * hits.opacity).sum()
        depth = -torch.log(1.0 - hits.opacity + o.left)
        loss = loss + torch.where(hits.opacity > MOSTLY_BLOCKED, o.blocked * depth, torch.zeros_like(depth)).sum()
    asked = len(eikonal.points) + (count if len(light.used) else len(eikonal.noise))
    off = torch.linalg.vector_norm(slopes, dim=-1) - 1.0
    loss = loss + eikonal.weight / max(asked, 1) * (torch.where(off < 0.0, shallow, 1.0) * off.square()).sum()
    loss = loss + _pull_together(hits, grid, network, rays, smooth)
    loss.backward()
    learned = *network[:2], *shader, *light[:-1], far_light, gains.log_gain
    return Learned(loss.detach(), sum_of_gradients(learned), squared, hits.samples)


def sum_of_gradients(tensors: Iterable[Tensor]) -> Tensor:
    """Of those that have any, a scalar."""
    return torch.cat([t.grad.flatten() for t in tensors if t.grad is not None]).sum()


def with_far_light(hits: Hits, far_light: Tensor) -> Hits:
    """What is shaded. Light from beyond everything has features (F,), too, and no place: only a direction; it is mixed into the last
    surface of each ray, so that no ray ends in the dark. Without any (0,) hits stay as they are."""
    if not len(far_light):
        return hits
    last = torch.where(hits.behind >= 0, hits.behind, torch.arange(len(hits.behind), device=hits.behind.device))
    passed = torch.zeros_like(hits.share).index_add(0, last, 1.0 - hits.opacity)
    share = hits.share + passed
    mixed = (passed / share.clamp(min=LEAST_WEIGHT))[:, None]
    return hits._replace(features=torch.lerp(hits.features, far_light.expand_as(hits.features), mixed), share=share)


def surface_gradient(
    positions: Tensor, epsilon: float, grid: GridTable, network: SurfaceNetwork, surface_value: Evaluation = reference.surface_value
) -> Tensor:
    """∇sdf by four-tap differences of size ``epsilon`` (Neuralangelo, Li et al. 2023): (N, 3) in the frame of the grid → (N, 3)."""
    taps = positions.new_tensor(TAPS)
    shifted = positions[:, None] + taps * (epsilon / 3**0.5)
    values = surface_value(shifted.reshape(-1, 3), grid, network).reshape(-1, 4)
    return (values @ taps) * (3**0.5 / (4 * epsilon))


def normals(points: Tensor, slopes: Tensor, extent: float) -> Tensor:
    """Unit, outward (N, 3), at points (N, 3) of the normalised frame, from ∇sdf in the frame of the grid."""
    if extent > 1.0:
        slopes = reference.contracted_velocity(points, slopes)  # the chain rule: the contraction's Jacobian is symmetric
    return normalize(slopes, dim=-1)


def _mirrors(
    hits: Hits, ray: Tensor, grid: GridTable, network: SurfaceNetwork, light: LightNetwork, rays: Rays, view: View, eikonal: Eikonal
) -> tuple[Lamps, Mirrors, Tensor]:
    """Lamps, the surfaces as their mirrors, and ∇sdf (N, 3) at those that are met."""
    parts = light.second.shape[0] - light.position.shape[0]
    columns = torch.cat([torch.arange(parts, device=light.used.device), parts + light.used])
    hidden = torch.relu(linear(hits.features, light.first, light.first_bias))
    material = linear(hidden, light.second[columns], light.second_bias[columns])
    points = rays.origins[ray] + rays.directions[ray] * hits.distance[:, None]
    at = reference.contract(points) if grid.extent > 1.0 else points
    slopes = surface_gradient(at, eikonal.mirror_epsilon, grid, network)
    trains = view.trains_geometry[ray]
    kept = lambda x: torch.where(trains if x.dim() == 1 else trains[:, None], x, x.detach())
    outward = normals(points, slopes, grid.extent)
    share = torch.where(hits.distance > 0, hits.share, torch.zeros_like(hits.share))  # without a place there is no normal
    mirrors = Mirrors(kept(material), kept(outward), points, rays.directions[ray], kept(share))
    lamps = Lamps(light.position[light.used], torch.exp(light.log_spectrum[light.used]))
    return lamps, mirrors, slopes[hits.distance > 0]


def asked_rays(rays: int, asked: int) -> Tensor:
    """Of so many rays those, evenly spaced, of which something is asked: (min(rays, asked),)."""
    asked = min(rays, asked)
    return torch.arange(asked) * rays // max(asked, 1)


def pairs_of(rays: int, smooth: Smooth) -> int:
    """Of so many rays how many have a neighbour."""
    return min(len(smooth.aside), rays // RAYS_OF_PAIR)


def _pull_together(hits: Hits, grid: GridTable, network: SurfaceNetwork, rays: Rays, smooth: Smooth) -> Tensor:
    """See ``Smooth``."""
    pairs = pairs_of(len(rays.origins), smooth)
    chosen = asked_rays(len(rays.origins), pairs).to(hits.depth.device)
    depth, distance = hits.depth[chosen], lambda x: torch.linalg.vector_norm(x, dim=-1)
    points = rays.origins[chosen] + rays.directions[chosen] * depth[:, None]
    beside = points + smooth.aside[:pairs] * distance(points)[:, None]
    asked = torch.isfinite(depth) & (distance(points) > 1.0) & (distance(beside) > 1.0)
    points = torch.cat([points[asked], beside[asked]])
    at = reference.contract(points) if grid.extent > 1.0 else points
    one, other = normals(points, surface_gradient(at, smooth.epsilon, grid, network), grid.extent).chunk(2)
    apart = 0.5 * (one - other).square().sum(-1)
    return smooth.weight / max(pairs, 1) * (apart / (apart + SOFT_EDGE)).sum()


def _at_points(hits: Hits, grid: GridTable, network: SurfaceNetwork, rays: Rays, eikonal: Eikonal) -> tuple[Tensor, Tensor]:
    """∇sdf (N, 3) at the points of all space and, beside the surfaces that rays meet, where it is asked; the factors of slopes below 1."""
    at = [eikonal.points]
    if len(eikonal.noise):
        chosen = asked_rays(len(rays.origins), len(eikonal.noise)).to(hits.depth.device)
        depth = hits.depth[chosen]
        met = rays.origins[chosen] + rays.directions[chosen] * depth[:, None]
        near = (reference.contract(met) if grid.extent > 1.0 else met) + eikonal.noise[: len(chosen)]
        at.append(near[torch.isfinite(depth)])
    points = torch.cat(at)
    within = torch.linalg.vector_norm(points, dim=-1) < 1.0
    shallow = torch.where(within, eikonal.shallow, 1.0).to(points)
    return surface_gradient(points, eikonal.epsilon, grid, network), shallow
