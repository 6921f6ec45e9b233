"""What surfaces mirror of lamps, in plain torch: the definition, on any device and in any precision, of which ``reference`` is the rest.

With normal n, direction to the viewer v, direction to lamp k l and h halfway between, a microfacet model (Walter et al. 2007)

    L = Σ_k I_k V_k s · D(n·h) / D(1) · F(v·h) / F(1) · G / 4,   G / (n·v) ≈ (n·l) / ((n·l (1 - c) + c) (n·v (1 - c) + c)),  c = α / 2

D: GGX with roughness α; F: Schlick's approximation of Fresnel's reflectance of glass (n = 1.5); G: Smith's masking, in Schlick's form
(Karis 2013). D and F are relative to their values at the top and at normal incidence: the strength s is then the height of a highlight,
whatever its width. α, s and the lamps' visibilities V_k belong to places of the surface, positions and spectra I_k to the lamps. The
mirrored light of a dielectric is polarized by Fresnel's equations, perpendicular to the plane of incidence, that of a metal less: by a part
p of the degree.

Light that comes from all around is polarized, too, about the plane of v and n, and cameras behind analysers see it: the surroundings,
mirrored, by m F(v·n) / F(1) of degree D_m, and the light of the body itself, which leaves it through the surface (Atkinson and Hancock
2006), by t of degree D_t along the plane. With w = v × n, e the analyser's axis

    I = m F / 2 (1 + D_m q / |w|²) + t / 2 (1 - D_t q / |w|²),   q = 2 (e·w)² - |w|².

m and t belong to places of the surface and are parts of the light of polarization modalities; the others' shader paints all of it.

Symbols: H surfaces that rays meet, K lamps, R rays, M numbers measured along them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize, softplus

from mmsynth.field.kernels.constants import LEAST_ROUGHNESS, REFRACTIVE_INDEX
from mmsynth.field.kernels.parameters import Lamps, Measured, Mirrors
from mmsynth.field.kernels.shading import rays_of

_AT_NORMAL = ((REFRACTIVE_INDEX - 1.0) / (REFRACTIVE_INDEX + 1.0)) ** 2


class Reflection(NamedTuple):
    """Of H surfaces and K lamps: ``amount`` (H, K) of the lamp's spectrum that is seen; ``axis`` (H, K, 3), the unit vector perpendicular
    to the plane of incidence, and ``degree`` (H, K), how far the light is polarized along it."""

    amount: Tensor
    axis: Tensor
    degree: Tensor


class Material(NamedTuple):
    """Roughness α in (0, 1), strength s, surroundings m and transmitted t ≥ 0, polarizing p in [0, 1], (H,); visibility of each lamp in
    [0, 1], (H, K)."""

    roughness: Tensor
    strength: Tensor
    surroundings: Tensor
    transmitted: Tensor
    polarizing: Tensor
    visibility: Tensor


class Surroundings(NamedTuple):
    """Of light from all around that H surfaces mirror or let through: ``axis`` w (H, 3), ``light`` (H,) and ``polarized`` (H,), the S0 of
    what swings along w less that of what swings across it, over |w|²."""

    axis: Tensor
    light: Tensor
    polarized: Tensor


def material(raw: Tensor) -> Material:
    """From (H, 5 + K) numbers."""
    roughness = LEAST_ROUGHNESS + (1.0 - LEAST_ROUGHNESS) * torch.sigmoid(raw[:, 0])
    light = softplus(raw[:, 1:4])
    return Material(roughness, light[:, 0], light[:, 1], light[:, 2], torch.sigmoid(raw[:, 4]), torch.sigmoid(raw[:, 5:]))


def reflect(position: Tensor, mirrors: Mirrors) -> Reflection:
    """What surfaces mirror of lamps at (K, 3). No gradient passes through Fresnel's equations: the lobes tell where a lamp is."""
    roughness, strength, _, _, polarizing, visibility = material(mirrors.material)
    toward = normalize(position - mirrors.points[:, None], dim=-1)
    view, n = -mirrors.directions[:, None], mirrors.normals[:, None]
    half = normalize(toward + view, dim=-1)
    # the sine from the cross product: 1 - cos² would lose the narrow lobes to rounding
    off = torch.linalg.cross(n.expand_as(half), half, dim=-1).square().sum(-1)
    square = roughness.square()[:, None]
    lobe = (square / (square + (1.0 - square) * off)).square()
    to_lamp, to_viewer = ((n * x).sum(-1).clamp(min=0.0) for x in (toward, view))
    c = 0.5 * roughness[:, None]
    seen = to_lamp / ((to_lamp * (1.0 - c) + c) * (to_viewer * (1.0 - c) + c))
    with torch.no_grad():
        facing = (n * half).sum(-1) > 0.0
        incidence = (view * half).sum(-1).clamp(0.0, 1.0)
        fresnel = 1.0 + (1.0 / _AT_NORMAL - 1.0) * (1.0 - incidence).pow(5)
        axis, degree = _polarization(view, half, incidence)
    amount = torch.where(facing, 0.25 * lobe * seen * fresnel, torch.zeros_like(lobe)) * strength[:, None] * visibility
    return Reflection(amount, axis, degree * polarizing[:, None])


def _polarization(view: Tensor, half: Tensor, incidence: Tensor) -> tuple[Tensor, Tensor]:
    """Axis (H, K, 3) and degree (H, K) of the polarization of mirrored light; Fresnel's equations at the cosine of ``incidence``."""
    across = torch.linalg.cross(view.expand_as(half), half, dim=-1)
    length = torch.linalg.vector_norm(across, dim=-1, keepdim=True)
    axis = across / length.clamp(min=1e-12)  # head on there is no plane of incidence, and no polarization either
    transmitted = torch.sqrt(1.0 - (1.0 - incidence.square()) / REFRACTIVE_INDEX**2)
    perpendicular = ((incidence - REFRACTIVE_INDEX * transmitted) / (incidence + REFRACTIVE_INDEX * transmitted)).square()
    parallel = ((REFRACTIVE_INDEX * incidence - transmitted) / (REFRACTIVE_INDEX * incidence + transmitted)).square()
    return axis, (perpendicular - parallel) / (perpendicular + parallel)


def surround(mirrors: Mirrors) -> Surroundings:
    """Polarized light from all around. Through Fresnel's equations no gradient passes here either, only through the axis."""
    met = (mirrors.share > 0.0)[:, None]
    of = material(torch.where(met, mirrors.material, torch.zeros_like(mirrors.material)))
    view = -mirrors.directions
    n = torch.where(met, mirrors.normals, view)  # what is not met has no normal
    with torch.no_grad():
        c = (view * n).sum(-1).clamp(0.0, 1.0)
        schlick, mirrored, transmitted = fresnel_degrees(c)
    mirror = of.surroundings * schlick
    return Surroundings(torch.linalg.cross(view, n, dim=-1), mirror + of.transmitted, mirror * mirrored - of.transmitted * transmitted)


def fresnel_degrees(c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """At angles of cosine c: Schlick's F / F(1), and the degrees of polarization of mirrored and transmitted light over sin².

    With the cosine c' behind the surface, cos(i ∓ t) = c c' ± sin² / n and sin(i - t) = sin (c' - c / n), nothing cancels and nothing is
    divided by 0, head on or grazing: D_m / sin² = (2 c c' / n) / ((c c')² + (sin² / n)²), D_t / sin² = (c' - c / n)² / (1 + cos²(i - t)).
    """
    square = 1.0 - c * c
    inner = torch.sqrt(1.0 - square / REFRACTIVE_INDEX**2)
    product, along = c * inner, square / REFRACTIVE_INDEX
    mirrored = 2.0 * product / REFRACTIVE_INDEX / (product * product + along * along)
    transmitted = (inner - c / REFRACTIVE_INDEX).square() / (1.0 + (product + along).square())
    return 1.0 + (1.0 / _AT_NORMAL - 1.0) * (1.0 - c).pow(5), mirrored, transmitted


def mirror(lamps: Lamps, mirrors: Mirrors, behind: Tensor, measured: Measured) -> Tensor:
    """Mirrored light in each measured number, relative to its modality's typical value, (M,).

    Args:
        mirrors: what R rays meet. behind: (R,), see ``Hits``.
    """
    reflection, rays = reflect(lamps.position, mirrors), len(behind)
    share = mirrors.share[:, None]
    amount = torch.where(share > 0.0, share * reflection.amount, torch.zeros_like(reflection.amount))  # what is not met has no normal
    bright = len(measured.ray) - len(measured.axes)
    of_ray = amount[:rays].index_add(0, rays_of(behind, len(amount))[rays:], amount[rays:])
    spectra = lamps.spectrum[:, measured.output].T
    seen = (of_ray[measured.ray[:bright]] * spectra[:bright]).sum(1)
    if not len(measured.axes):
        return seen
    row = behind[measured.ray[bright:]]
    front = _behind_analyser(amount, reflection, measured.ray[bright:], measured.axes)
    second = torch.where(row[:, None] >= 0, _behind_analyser(amount, reflection, row.clamp(min=0), measured.axes), torch.zeros_like(front))
    around, met = surround(mirrors), torch.where(mirrors.share > 0.0, mirrors.share, torch.zeros_like(mirrors.share))
    near = _around_behind_analyser(met, around, measured.ray[bright:], measured.axes)
    far = _around_behind_analyser(met, around, row.clamp(min=0), measured.axes)
    return torch.cat([seen, ((front + second) * spectra[bright:]).sum(1) + near + torch.where(row >= 0, far, torch.zeros_like(far))])


def _behind_analyser(amount: Tensor, reflection: Reflection, row: Tensor, axes: Tensor) -> Tensor:
    """(P, K): eᵀ J e = S0 / 2 (1 + D (2 (e·a)² - 1)) of rows, for axes e (P, 3)."""
    along = (reflection.axis[row] * axes[:, None]).sum(-1).square()
    return 0.5 * amount[row] * (1.0 + reflection.degree[row] * (2.0 * along - 1.0))


def _around_behind_analyser(share: Tensor, around: Surroundings, row: Tensor, axes: Tensor) -> Tensor:
    """(P,): share / 2 (light + polarized q) of rows, for axes e (P, 3)."""
    axis = around.axis[row]
    q = 2.0 * (axis * axes).sum(-1).square() - axis.square().sum(-1)
    return 0.5 * share[row] * (around.light[row] + around.polarized[row] * q)
