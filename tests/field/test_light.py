"""Mirrored lamps: the fused kernel against the definition, the definition against closed forms, rendering against what a fit compares."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from from_python import from_python
from torch import Tensor
from torch.nn.functional import normalize

from mmsynth.field import kernels
from mmsynth.field.kernels import Lamps, Measured, Mirrors
from mmsynth.field.kernels.cpu import logistic
from mmsynth.field.kernels.mirroring import fresnel_degrees, material, reflect, surround
from mmsynth.field.light import LAMPS, Light, find_lamps, stokes, stokes_around
from mmsynth.sensors.polarization import stokes_to_intensities

OUTPUTS = 9


def _case(rays: int, per_ray: int = 1, lamps: int = 3, polarized: float = 0.4) -> tuple[Lamps, Mirrors, Tensor, Measured]:
    """Surfaces of all roughnesses, seen and lit from all sides; a third of the rays meets two, a fifth nothing."""
    g = torch.Generator().manual_seed(rays + per_ray)
    normal = lambda *shape: torch.randn(*shape, generator=g)
    twice = torch.nonzero(torch.rand(rays, generator=g) < 0.3)[:, 0]
    behind = torch.full((rays,), -1)
    behind[twice] = torch.arange(rays, rays + len(twice))
    rows = rays + len(twice)
    normals = normalize(normal(rows, 3), dim=1)
    share = torch.rand(rows, generator=g)
    share[:rays][(torch.rand(rays, generator=g) < 0.2) & (behind < 0)] = 0.0
    mirrors = Mirrors(
        2.0 * normal(rows, 5 + lamps), normals, 0.5 * normal(rows, 3), normalize(0.7 * normal(rows, 3) - normals, dim=1), share
    )
    ray = torch.arange(rays).repeat_interleave(per_ray)
    axes = normalize(normal(int(polarized * rays) * per_ray, 3), dim=1)
    output = torch.randint(3, (len(ray),), generator=g)
    output[len(ray) - len(axes) :] = 3
    one = torch.ones(len(ray))
    spectrum = torch.rand(lamps, OUTPUTS, generator=g) + 0.5
    return Lamps(4.0 * normalize(normal(lamps, 3), dim=1), spectrum), mirrors, behind, Measured(one, ray, output, axes, one, one, one)


def _quantities(case: tuple[Lamps, Mirrors, Tensor, Measured], dtype: torch.dtype) -> dict[str, Tensor]:
    lamps, mirrors, behind, measured = case
    to = lambda parts: type(parts)(*(x.detach().clone().to(dtype) for x in parts))
    lamps, mirrors = to(lamps), to(mirrors)
    of_mirrors = {name: getattr(mirrors, name) for name in ("material", "normals", "share")}
    differentiable = {"position": lamps.position, "spectrum": lamps.spectrum, **of_mirrors}
    for x in differentiable.values():
        x.requires_grad_()
    seen = kernels.mirror(lamps, mirrors, behind, measured._replace(axes=measured.axes.to(dtype)))
    (seen * torch.linspace(0.5, 1.5, len(seen), dtype=dtype)).sum().backward()
    return {"light": seen.detach(), **{f"gradient of {n}": x.grad for n, x in differentiable.items() if x.grad is not None}}


@pytest.mark.parametrize(
    ("rays", "per_ray", "lamps", "polarized"), [(300, 1, 3, 0.4), (64, 3, 1, 0.0), (65, 2, LAMPS, 1.0), (1, 1, 2, 0.0)]
)
def test_fused_is_the_definition(rays: int, per_ray: int, lamps: int, polarized: float) -> None:
    case = _case(rays, per_ray, lamps, polarized)
    found, expected = _quantities(case, torch.float32), _quantities(case, torch.float64)
    assert len(found) == 6 and expected["light"].any()
    for name, value in found.items():
        assert value.dtype == torch.float32 and torch.isfinite(value).all(), name
        assert float((value - expected[name]).abs().max()) <= 5e-6 * float(expected[name].abs().max()) + 1e-12, name


def test_no_rays() -> None:
    found = _quantities(_case(0), torch.float32)
    assert len(found["light"]) == 0 and not any(x.any() for x in found.values())


def test_the_gradient_of_the_definition_is_that_of_differences() -> None:
    lamps, mirrors, behind, measured = _case(12, 2)
    to = lambda x: x.double().requires_grad_()
    measured = measured._replace(axes=measured.axes.double())

    def seen(spectrum: Tensor, material: Tensor, share: Tensor) -> Tensor:
        parts = Mirrors(material, mirrors.normals.double(), mirrors.points.double(), mirrors.directions.double(), share)
        return kernels.mirror(Lamps(lamps.position.double(), spectrum), parts, behind, measured)

    shared = mirrors.share.clamp(min=0.1)
    assert torch.autograd.gradcheck(seen, (to(lamps.spectrum), to(mirrors.material), to(shared)))


def _one(
    normal: list[float], viewer: list[float], lamp: list[float], raw: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> kernels.Reflection:
    """One surface at the origin, seen from and lit from directions."""
    vector = lambda x: normalize(torch.tensor([x], dtype=torch.float64), dim=1)
    mirrors = Mirrors(
        torch.tensor([[*raw[:2], 0.0, 0.0, 60.0, raw[2]]], dtype=torch.float64),
        vector(normal),
        torch.zeros(1, 3, dtype=torch.float64),
        -vector(viewer),
        torch.ones(1),
    )
    return reflect(5.0 * vector(lamp), mirrors)


def test_polarization_is_fresnels() -> None:
    """None head on; all of it at Brewster's angle, tan θ = 1.5, perpendicular to the plane of incidence."""
    assert float(_one([0, 0, 1], [0, 0, 1], [0, 0, 1]).degree) == pytest.approx(0.0, abs=1e-12)
    brewster = _one([0, 0, 1], [1.5, 0, 1], [-1.5, 0, 1])
    assert float(brewster.degree) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(brewster.axis[0, 0].abs(), [0.0, 1.0, 0.0], atol=1e-12)


def test_light_from_all_around_is_polarized_as_fresnel_says() -> None:
    """Against the equations by their amplitudes, in float64; and in float32 to rounding, head on and grazing."""
    i = torch.linspace(0.01, 1.56, 300, dtype=torch.float64)
    t = torch.asin(i.sin() / 1.5)
    perpendicular, parallel = ((i - t).sin() / (i + t).sin()).square(), ((i - t).tan() / (i + t).tan()).square()
    _, mirrored, transmitted = fresnel_degrees(i.cos())
    square = i.sin().square()
    torch.testing.assert_close(mirrored * square, (perpendicular - parallel) / (perpendicular + parallel), atol=1e-9, rtol=1e-7)
    torch.testing.assert_close(transmitted * square, (perpendicular - parallel) / (2.0 - perpendicular - parallel), atol=1e-9, rtol=1e-7)
    c = torch.tensor([1.0, 1.0 - 1e-7, 1e-7, 0.0])
    for found, expected in zip(fresnel_degrees(c), fresnel_degrees(c.double()), strict=True):
        torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=1e-5)


def test_the_compiled_reflection_is_the_definition() -> None:
    lamps, mirrors, _, _ = _case(500, 3)
    with torch.no_grad():
        found = kernels.reflect(lamps.position, mirrors)
    expected = reflect(lamps.position.double(), Mirrors(*(x.double() for x in mirrors)))
    assert (expected.amount > 0).any() and (expected.amount == 0).any()
    for name, values, exact in zip(expected._fields, found, expected, strict=True):
        torch.testing.assert_close(values.double(), exact, atol=2e-5, rtol=1e-4, msg=lambda text, name=name: f"{name}: {text}")
    position = lamps.position.clone().requires_grad_()
    kernels.reflect(position, mirrors).amount.sum().backward()  # with a gradient it is the definition
    assert position.grad is not None and position.grad.abs().sum() > 0


def test_a_mirror_is_brightest_where_the_angles_are_equal() -> None:
    """At the top of a lobe L = s V F / F(1) n·l / 4 (...): the closed form, and less beside it."""
    raw = (-2.0, 1.0, 3.0)
    of = material(torch.tensor([[*raw[:2], 0.0, 0.0, 60.0, raw[2]]], dtype=torch.float64))
    alpha, strength, visibility = (float(x) for x in (of.roughness, of.strength, of.visibility))
    cos = math.cos(math.radians(40.0))
    c = 0.5 * alpha
    seen = cos / (cos * (1 - c) + c) ** 2
    top = 0.25 * (1.0 + 24.0 * (1.0 - cos) ** 5) * seen * strength * visibility
    side = math.sin(math.radians(40.0))
    assert float(_one([0, 0, 1], [side, 0, cos], [-side, 0, cos], raw).amount) == pytest.approx(top, rel=1e-12)
    assert all(float(_one([x, y, 1], [side, 0, cos], [-side, 0, cos], raw).amount) < top for x, y in ((0.1, 0), (-0.1, 0), (0, 0.1)))


def test_stokes_vectors_are_what_analysers_pass() -> None:
    """The rendering's Stokes vectors, behind analysers, are the fit's numbers."""
    lamps, mirrors, behind, measured = _case(40, 1, polarized=1.0)
    mirrors, behind = Mirrors(*(x[:40] for x in mirrors)), torch.full((40,), -1)
    x = normalize(torch.linalg.cross(mirrors.directions, mirrors.normals), dim=1)
    y = torch.linalg.cross(x, mirrors.directions)
    for angle in (0.0, 30.0, 100.0):
        turned = math.radians(angle)
        found = kernels.mirror(lamps, mirrors, behind, measured._replace(axes=math.cos(turned) * x + math.sin(turned) * y))
        vectors = stokes(reflect(lamps.position, mirrors), lamps.spectrum[:, 3], x, y) + stokes_around(surround(mirrors), x, y)
        vectors = mirrors.share[:, None] * vectors
        torch.testing.assert_close(found, stokes_to_intensities(vectors, (angle,))[:, 0], atol=1e-6, rtol=1e-5)
        assert (vectors[:, 1:].norm(dim=1) <= vectors[:, 0] * (1 + 1e-6)).all()


def test_lamps_are_found_where_mirrored_rays_are_bright() -> None:
    g = torch.Generator().manual_seed(3)
    true = normalize(torch.tensor([[0.5, 0.4, 0.8], [-0.7, 0.2, 0.6], [0.1, -0.9, 0.4]]), dim=1)
    reflected = normalize(torch.randn(20000, 3, generator=g), dim=1)
    light = torch.exp(60.0 * (reflected @ true.T - 1.0)).sum(1) + 0.05 * torch.rand(20000, generator=g)
    found = find_lamps(reflected, light)
    assert len(found) == 3 and float((found @ true.T).amax(0).min()) > math.cos(math.radians(6.0))
    assert len(find_lamps(reflected, torch.zeros(20000))) == 0


def test_a_lamp_that_was_missed_is_found_beside_those_that_are_known() -> None:
    g = torch.Generator().manual_seed(4)
    true = normalize(torch.tensor([[0.5, 0.4, 0.8], [-0.7, 0.2, 0.6], [0.1, -0.9, 0.4]]), dim=1)
    reflected = normalize(torch.randn(20000, 3, generator=g), dim=1)
    lobes = torch.exp(60.0 * (reflected @ true.T - 1.0))
    noise = 0.05 * torch.rand(20000, generator=g)
    found = find_lamps(reflected, lobes.sum(1) + noise, lobes[:, 2] + noise, true[:2])
    assert len(found) == 1 and float(found[0] @ true[2]) > math.cos(math.radians(6.0))
    # a known lamp that is too faint is not found twice, and what is left of all of them is no lamp
    assert len(find_lamps(reflected, lobes.sum(1), 0.5 * lobes[:, :2].sum(1), true[:2])) == 0
    assert len(find_lamps(reflected, lobes.sum(1), 0.2 * lobes.sum(1), true[:0])) == 0
    everywhere = normalize(torch.randn(LAMPS, 3, generator=g), dim=1)
    assert len(find_lamps(reflected, lobes.sum(1), lobes.sum(1), everywhere)) == 0  # there is no place for another


def test_a_place_that_a_lamp_left_is_as_new() -> None:
    light = Light(8, OUTPUTS)
    light.add(torch.ones(2, 3))
    with torch.no_grad():
        light.log_spectrum.fill_(-5.0)
        light.second.weight.fill_(1.0)
        light.used[0] = False
    light.add(torch.full((1, 3), 2.0))
    assert light.used.tolist() == [True, True, *[False] * (LAMPS - 2)]
    assert light.position[:2, 0].tolist() == [2.0, 1.0]
    spectrum = light.log_spectrum.detach()
    assert not spectrum[0].any() and bool((spectrum[1] == -5.0).all())
    seen = torch.sigmoid(light.material(torch.randn(5, 8))[:, 5])
    torch.testing.assert_close(seen, seen[:1].expand(5))


def test_a_light_has_as_many_lamps_as_were_put() -> None:
    light = Light(8, OUTPUTS)
    assert light.material(torch.randn(5, 8)).shape == (5, 5) and light.lamps().spectrum.shape == (0, OUTPUTS)
    light.add(torch.ones(2, 3))
    assert light.material(torch.randn(5, 8)).shape == (5, 7) and light.lamps().position.shape == (2, 3)
    assert torch.equal(light.lamps().spectrum, torch.ones(2, OUTPUTS))


def test_softplus_of_many_numbers_and_its_slope_are_exact_to_rounding_and_nan_is_seen() -> None:
    x = np.append(np.linspace(-79.0, 79.0, 10001), np.nan).astype(np.float32)
    value, slope = np.empty_like(x), np.empty_like(x)
    from_python(logistic.softplus)(x, len(x), value, slope)
    exact = x[:-1].astype(np.float64)
    np.testing.assert_allclose(value[:-1], np.logaddexp(0.0, exact), rtol=4e-7)
    np.testing.assert_allclose(slope[:-1], 1.0 / (1.0 + np.exp(-exact)), rtol=4e-7)
    assert np.isnan(value[-1]) and np.isnan(slope[-1])
