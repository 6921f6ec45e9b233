"""Shading and mirrored lamps in Triton: the cases of the CPU's kernels, against the definition in float64."""

from collections.abc import Iterator

import pytest
import test_light
import test_shading
import torch
from on_device import make_on_cpu
from test_shading import ANALYSERS, FILM, MOSAIC, TENSOR

from mmsynth.field import kernels
from mmsynth.field.kernels import Lamps, Measured, Mirrors, cuda, reference


@pytest.fixture(autouse=True)
def _by_triton(device: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(kernels, "_backend", lambda tensor: cuda if tensor.dtype == torch.float32 else reference)
    for module in (test_light, test_shading):
        make_on_cpu(module, "_case", device, monkeypatch)
    with torch.device(device):
        yield


def test_compare() -> None:
    test_shading._check(test_shading._case(20))


@pytest.mark.parametrize("modalities", [(FILM,), (TENSOR,), (ANALYSERS, MOSAIC)])
def test_compare_some_modalities(modalities: tuple[test_shading.Modality, ...]) -> None:
    test_shading._check(test_shading._case(17, modalities, gains=False))


@pytest.mark.parametrize(("width", "hidden"), [(4, 4), (33, 33)])
def test_compare_with_layers_of_parts_of_tiles(width: int, hidden: int) -> None:
    test_shading._check(test_shading._case(9, width=width, hidden=hidden))


@pytest.mark.parametrize("raw", [90.0, -1e4])
def test_outputs_far_from_zero(raw: float) -> None:
    case = test_shading._case(9, gains=False)
    with torch.no_grad():
        case.shader.heads.bias.fill_(raw)
    test_shading._check(case)


def test_scarce_rays_teach_the_heads_alone() -> None:
    case = test_shading._case(9)
    case.trains_geometry[:] = False
    taught = {name for name, value in test_shading._check(case).items() if value.any()}
    assert taught == {"loss", "squared", "gradient of gain", "gradient of heads.weight", "gradient of heads.bias"}


def test_what_is_not_a_number_is_seen_in_the_loss() -> None:
    for name, value in (("features", torch.nan), ("share", torch.nan), ("gain", torch.nan), ("features", torch.inf)):
        case = test_shading._case(9)
        getattr(case, name)[7] = value
        assert not torch.isfinite(test_shading._compare(case)[0]), name


def test_no_rays() -> None:
    test_shading.test_no_rays()
    test_light.test_no_rays()


@pytest.mark.parametrize(("rays", "per_ray", "lamps", "polarized"), [(40, 1, 3, 0.4), (33, 3, 1, 0.0), (33, 2, 6, 1.0)])
def test_mirrors(rays: int, per_ray: int, lamps: int, polarized: float) -> None:
    test_light.test_fused_is_the_definition(rays, per_ray, lamps, polarized)


def test_two_rows_for_every_ray_are_as_good_as_those_that_are_met() -> None:
    """``Hits`` as Triton's trace makes them: the definition and the kernels see the same light in them."""
    lamps, mirrors, behind, measured = test_light._case(30)
    twice, rays = behind >= 0, len(behind)
    kept = torch.cat([torch.arange(rays), rays + torch.nonzero(twice)[:, 0]])
    wide = Mirrors(*(torch.zeros(2 * rays, *x.shape[1:]).index_copy(0, kept, x) for x in mirrors))
    row = torch.where(twice, torch.arange(rays, 2 * rays), -1)
    expected = kernels.mirror(lamps, mirrors, behind, measured)
    exact = lambda parts, kind: kind(*(x.double() if x.is_floating_point() else x for x in parts))
    torch.testing.assert_close(kernels.mirror(lamps, wide, row, measured), expected)
    defined = reference.mirror(exact(lamps, Lamps), exact(wide, Mirrors), row, exact(measured, Measured))
    torch.testing.assert_close(defined.float(), expected, atol=1e-6, rtol=1e-5)
