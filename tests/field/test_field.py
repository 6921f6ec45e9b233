"""What a field says in the world's frame and unit, and its shader."""

from __future__ import annotations

import copy
import dataclasses
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize, softplus

from mmsynth import parallel
from mmsynth.errors import InputError
from mmsynth.field import field as fields
from mmsynth.field import kernels, rendering
from mmsynth.field.design import Design
from mmsynth.field.field import Field
from mmsynth.field.kernels import intensity, radiance
from mmsynth.field.light import Light
from mmsynth.field.light_rendering import render_light
from mmsynth.field.radiance import Shader
from mmsynth.field.storage import load_field, save_field
from mmsynth.scene.scene import Region, Sensor
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.polarization import coherency_from_factor, coherency_to_stokes

RGB = Sensor("rgb", ("R", "G", "B"), (None, None, None))
POL = Sensor("pol", ("0", "45", "90", "135"), (None,) * 4, None, (0.0, 45.0, 90.0, 135.0))
NIR = Sensor("nir", ("nir",), (850.0,))
SENSORS, LEVELS = {s.name: s for s in (RGB, POL, NIR)}, {"rgb": 0.5, "pol": 0.25, "nir": 2.0}


def _field(background: bool, region: Region | None = None) -> Field:
    torch.manual_seed(0)
    design = Design(
        surface_levels=2, radiance_levels=2, surface_rows_log2=12, radiance_rows_log2=10, surface_finest=128, radiance_finest=12,
        background=background, outer_radius=1.9, surface_hidden=8, radiance_hidden=8, coarsest=5, occupancy=16,
    )  # fmt: skip
    field = Field(design, dict(SENSORS), LEVELS, region or Region((0.0, 0.0, 0.0), 1.0))
    with torch.no_grad():
        field.surface.output_weight.normal_(0, 0.05)
        field.appearance.table.normal_()
    field.sampling = field.sampling._replace(sharpness=400.0, step=0.005)
    return field


def _look_around(field: Field, count: int) -> tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]:
    directions = normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    origins = torch.tensor([[0.75, 0.0, 0.0]]).expand(count, 3)
    x = normalize(torch.linalg.cross(directions, torch.tensor([[0.1, 0.2, 1.0]]).expand(count, 3)), dim=1)
    return origins, directions, field.render_rays(origins, directions, x, list(SENSORS), True)


@pytest.mark.parametrize("background", [False, True])
def test_normals_are_those_of_the_surface_that_is_seen(background: bool) -> None:
    """With a background the surface lies in contracted space: its normals do not."""
    field = _field(background)
    origins, directions, out = _look_around(field, 300)
    hit = torch.isfinite(out["depth"])
    points = (origins + directions * out["depth"][:, None])[hit].double().requires_grad_()
    field.double()
    place = kernels.contract(points) if background else points
    value = kernels.reference.surface_value(place, *field.surface.at(field.sampling.active_surface))
    apart = value.detach().abs()  # the depth is where the surface is; where a ray grazes it, within the soft part
    assert float(apart.quantile(0.95)) < 0.1 * field.sampling.step and float(apart.max()) < 3.5 / field.sampling.sharpness
    (slope,) = torch.autograd.grad(value.sum(), points)
    # differences over a cell: off by its size times the curvature
    assert float((normalize(slope, dim=1) * out["normal"][hit]).sum(1).min()) > 0.98
    far = points.detach().norm(dim=1) > 1.0
    assert hit.sum() > 30 and (not background or (far.sum() > 150 and hit.sum() > 270))
    assert out["normal"][~hit].isnan().all()


def test_only_what_is_asked_for_is_rendered() -> None:
    field = _field(False)
    camera = Camera(16, 12, 12.0, 12.0, 7.5, 5.5)
    pose = np.eye(4)
    pose[2, 3] = -1.5
    whole = field.render(camera, pose)
    for names, geometry in ((["nir"], False), ([], False), ([], True)):
        seen = field.render(camera, pose, names, geometry)
        assert list(seen.channels) == names and not seen.stokes
        for name in names:
            np.testing.assert_array_equal(seen.channels[name], whole.channels[name])
        for part in ("depth_z", "depth_ray", "opacity"):
            np.testing.assert_array_equal(getattr(seen, part), getattr(whole, part))
        if geometry:
            np.testing.assert_array_equal(seen.normal, whole.normal)
        else:
            assert np.isnan(seen.normal).all()
    assert np.isfinite(whole.depth_ray).sum() > 20 and np.isfinite(whole.normal).sum() > 60


def test_a_rendering_does_not_depend_on_how_many_rays_are_made_together(monkeypatch: pytest.MonkeyPatch) -> None:
    field, camera, pose = _field(False), Camera(19, 13, 12.0, 12.0, 7.5, 5.5, (-0.5, 0.1, 0.0, 0.0)), np.eye(4)
    pose[2, 3] = -1.5
    whole = field.render(camera, pose)
    for size in (16, 3):  # of either there are tiles that the lens does not see
        monkeypatch.setattr(fields, "TILE", size)
        done: list[int] = []
        seen = field.render(camera, pose, progress=done.append)
        assert sum(done) == whole.valid.sum() < whole.valid.size and len(done) == -(-whole.valid.size // size)
        assert max(done) <= size and 0 in done
        for part in ("depth_z", "depth_ray", "opacity", "normal", "valid"):
            np.testing.assert_allclose(getattr(seen, part), getattr(whole, part), atol=1e-6)
        for name in whole.channels:
            np.testing.assert_allclose(seen.channels[name], whole.channels[name], atol=1e-6)
        np.testing.assert_allclose(seen.stokes["pol"], whole.stokes["pol"], atol=1e-6)


@pytest.mark.parametrize("background", [False, True])
def test_pictures_are_the_same_to_the_bit_by_tiles_side_by_side(background: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    field, camera, pose = _field(background), Camera(64, 48, 50.0, 50.0, 31.5, 23.5, (-0.5, 0.1, 0.0, 0.0)), np.eye(4)
    pose[2, 3] = -1.5
    if not background:  # mirrors are most of what is not in the kernels
        field.light = Light(field.appearance.width, field.shader.heads.out_features)
        field.light.add(torch.tensor([[1.0, 2.0, -3.0], [0.0, 3.0, 1.0]]))
    monkeypatch.setattr(fields, "TILE", 128)
    seen = []
    for threads in (1, 3, 3):
        monkeypatch.setattr(parallel, "kernel_threads", lambda threads=threads: threads)
        seen.append(field.render(camera, pose))
    for other in seen[1:]:
        for part in ("depth_z", "opacity", "normal", "valid"):
            np.testing.assert_array_equal(getattr(other, part), getattr(seen[0], part))
        for name in SENSORS:
            np.testing.assert_array_equal(other.channels[name], seen[0].channels[name])
    assert np.isfinite(seen[0].depth_z).sum() > 300


def test_sdf_with_a_background_is_the_one_that_is_rendered() -> None:
    field = _field(True, Region((10.0, 0.0, -5.0), 3.0))
    x = np.array([[10.0, 0.0, -5.0], [10.0, 1.8, -5.0], [10.0, 0.0, 25.0], [-300.0, 200.0, 0.0]])
    unit = torch.from_numpy((x - [10.0, 0.0, -5.0]) / 3.0)
    expected = 3.0 * kernels.surface_value(kernels.contract(unit), *field.double().surface.at(2))
    np.testing.assert_allclose(field.float().sdf(x), expected.detach().numpy(), atol=1e-5)
    assert field.sdf(np.empty((0, 3))).shape == (0,)


@pytest.mark.parametrize("background", [False, True])
def test_what_rays_see_is_the_shader_of_their_features(background: bool) -> None:
    field = _field(background)
    origins, directions, out = _look_around(field, 200)
    hits = rendering.trace(field.surface, field.appearance, field.occupancy, origins, directions, torch.full((200,), 0.5), field.sampling)
    # opacity is the region's: a background is as opaque, and not what was looked for
    outside = (origins + directions * hits.depth[:, None]).norm(dim=1) > 1.001
    assert torch.equal(out["opacity"][~outside], hits.opacity[~outside].clamp(0, 1)) and not out["opacity"][outside].any()
    assert bool(outside.any()) == background and torch.equal(out["depth"].nan_to_num(), hits.depth.nan_to_num())
    nothing = hits.opacity == 0
    assert nothing.any() or background
    for name in SENSORS:
        assert out[name].shape == (200, SENSORS[name].channel_count)
        assert (out[name][~nothing] > 0).all() and not out[name][nothing].any()
    i0, i45, i90, i135 = out["pol"].unbind(1)
    s0, s1, s2 = out["stokes/pol"].unbind(1)
    for found, expected in ((s0, i0 + i90), (s0, i45 + i135), (s1, i0 - i90), (s2, i45 - i135)):
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    assert (torch.hypot(s1, s2) <= s0 * (1 + 1e-5)).all()


def test_a_degree_hides_the_direction_beyond_it() -> None:
    torch.manual_seed(0)
    shader = Shader(4, 8, SENSORS, LEVELS)
    features, directions = torch.randn(1, 4).expand(30, 4), normalize(torch.randn(30, 3), dim=1)
    none, linear, all_of_them = (shader(features, directions, degree) for degree in (0, 1, 3))
    torch.testing.assert_close(none, none[:1].expand(30, -1))
    assert linear.std(0).min() > 1e-4 and not torch.allclose(linear, all_of_them)
    degrees = torch.tensor([0, 1, 3]).repeat(10)
    expected = torch.stack([none, linear, all_of_them])[torch.tensor([0, 1, 2]).repeat(10), torch.arange(30)]
    torch.testing.assert_close(shader(features, directions, degrees), expected)


@pytest.mark.parametrize("features,hidden,rays", [(4, 8, 1), (24, 64, 131), (20, 20, 64)])
def test_shading_without_a_gradient_is_the_shader(features: int, hidden: int, rays: int) -> None:
    torch.manual_seed(0)
    shader = Shader(features, hidden, SENSORS, LEVELS)
    x, directions = torch.randn(rays, features), normalize(torch.randn(rays, 3), dim=1)
    for degree in range(4):
        with torch.no_grad():
            found = shader(x, directions, degree)
        assert found.shape == (rays, 10) and not found.requires_grad and shader(x, directions, degree).requires_grad
        truth = copy.deepcopy(shader).double()(x.double(), directions.double(), degree)
        torch.testing.assert_close(found.double(), truth.detach(), atol=1e-6, rtol=1e-5)
    with torch.no_grad():
        assert shader(x[:0], directions[:0], 1).shape == (0, 10)


def test_every_modality_has_the_view_dependence_that_it_needs() -> None:
    field = _field(False)
    field.view_dependence.update({"rgb": 0, "pol": 1, "nir": 3})
    origins, directions, out = _look_around(field, 100)
    hits = rendering.trace(field.surface, field.appearance, field.occupancy, origins, directions, torch.full((100,), 0.5), field.sampling)
    for name, degree in (("rgb", 0), ("nir", 3)):
        ray = kernels.rays_of(hits.behind, len(hits.share))
        light = hits.share[:, None] * field.shader.values(name, field.shader(hits.features, directions[ray], degree))
        expected = torch.zeros(100, light.shape[1]).index_add(0, ray, light)
        torch.testing.assert_close(out[name], expected.detach(), atol=1e-6, rtol=1e-5)


def test_what_is_rendered_of_lamps_is_what_a_fit_compares() -> None:
    field = _field(True)
    plain = _look_around(field, 200)[2]
    field.light = Light(field.appearance.width, field.shader.heads.out_features)
    origins, directions, out = _look_around(field, 200)
    assert all(torch.equal(out[name].nan_to_num(), plain[name].nan_to_num()) for name in plain)  # there are no lamps yet
    field.light.add(torch.tensor([[0.0, 0.0, 3.0], [2.0, 2.0, -1.0]]))
    origins, directions, out = _look_around(field, 200)
    hits = rendering.trace(field.surface, field.appearance, field.occupancy, origins, directions, torch.full((200,), 0.5), field.sampling)
    ray = torch.arange(200)
    for name in ("rgb", "nir"):
        column = field.shader.columns[name].start
        level = torch.full((200,), LEVELS[name])
        measured = kernels.Measured(level, ray, torch.full_like(ray, column), torch.empty(0, 3), level, level, level)
        expected = field.mirrored(hits, origins, directions, measured, field.sampling.active_surface).detach()
        torch.testing.assert_close(out[name][:, 0] - plain[name][:, 0], expected, atol=1e-6, rtol=1e-5)
        assert (expected > 1e-3).sum() > 20
    hit = out["normal"].isfinite().all(1)
    assert hit.sum() > 100 and float((out["normal"][hit] * plain["normal"][hit]).sum(1).quantile(0.1)) > 0.98


@pytest.mark.parametrize("lit", [False, True])
@pytest.mark.parametrize("background", [False, True])
def test_a_saved_field_is_the_same_field(tmp_path: Path, background: bool, lit: bool) -> None:
    field = _field(background, Region((1.0, 2.0, 3.0), 0.5))
    if lit:
        field.design = dataclasses.replace(field.design, light=True)
        field.light = Light(field.appearance.width, field.shader.heads.out_features)
        field.light.add(torch.ones(2, 3))
    field.view_dependence.update({"rgb": 0, "pol": 1, "nir": 3})
    field.occupancy.states[3, 4, 5] = 17
    field.sensors["nir"] = replace(NIR, saturation=float("inf"), mosaic=np.array([[0]]))
    save_field(field, tmp_path)
    again = load_field(tmp_path)
    assert (again.design, again.region, again.sampling, again.radiance_scale) == (
        field.design,
        field.region,
        field.sampling,
        field.radiance_scale,
    )
    assert again.view_dependence == field.view_dependence and again.sensors["nir"].saturation == float("inf")
    assert int(again.occupancy.states[3, 4, 5]) == 17 and again.surface.grid.extent == field.surface.grid.extent
    a, b = _look_around(field, 50)[2], _look_around(again, 50)[2]
    assert all(torch.equal(a[name].nan_to_num(), b[name].nan_to_num()) for name in a)


@pytest.mark.parametrize(("stated", "found"), [(None, "no format"), (1, "format 1"), (99, "format 99")])
def test_a_run_of_another_version_is_refused(tmp_path: Path, stated: int | None, found: str) -> None:
    save_field(_field(False), tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    del manifest["format"]
    (tmp_path / "manifest.json").write_text(json.dumps(manifest | ({} if stated is None else {"format": stated})))
    with pytest.raises(InputError, match=rf"manifest\.json: {found}, expected 2: .*another version of mmsynth; fit the scene again\.$"):
        load_field(tmp_path)


def test_modalities_have_their_own_outputs() -> None:
    shader = Shader(4, 8, SENSORS, LEVELS)
    assert {n: (c.start, c.stop) for n, c in shader.columns.items()} == {"rgb": (0, 3), "pol": (3, 9), "nir": (9, 10)}
    assert shader.heads.out_features == 10
    outputs = torch.randn(5, 10, requires_grad=True)
    torch.testing.assert_close(shader.values("rgb", outputs), 0.5 * softplus(outputs[:, :3]))
    torch.testing.assert_close(shader.values("nir", outputs), 2.0 * softplus(outputs[:, 9:]))
    x, y = torch.linalg.qr(torch.randn(5, 3, 2)).Q.unbind(-1)
    angles = torch.tensor([0.0, 0.7, 2.0])
    axes = torch.cos(angles)[None, :, None] * x[:, None] + torch.sin(angles)[None, :, None] * y[:, None]
    j = coherency_from_factor(outputs[:, 3:9]) @ coherency_from_factor(outputs[:, 3:9]).mT
    behind, stokes = shader.polarized("pol", outputs, x, y, angles)
    torch.testing.assert_close(behind, 0.25 * torch.einsum("rki,rij,rkj->rk", axes, j, axes))
    torch.testing.assert_close(stokes, 0.25 * coherency_to_stokes(j, x, y))
    (gradient,) = torch.autograd.grad(behind.sum(), outputs)
    assert gradient[:, 3:9].all() and not gradient[:, :3].any() and not gradient[:, 9:].any()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-30, 30, width=32), min_size=6, max_size=6), st.floats(0, 7))
def test_light_is_never_negative(raw: list[float], angle: float) -> None:
    numbers = torch.tensor(raw)
    axes = torch.tensor([[np.cos(angle), np.sin(angle), 0.0], [0.0, 0.6, -0.8]], dtype=torch.float32)
    assert (radiance(numbers) >= 0).all() and (intensity(numbers, axes) >= 0).all()
    # any two crossed analysers let the same light through in sum, and none lets more: DoLP ≤ 1
    crossed = torch.tensor([[-np.sin(angle), np.cos(angle), 0.0]], dtype=torch.float32)
    total = intensity(numbers, torch.eye(3)[:2]).sum()
    torch.testing.assert_close(intensity(numbers, axes[:1]).sum() + intensity(numbers, crossed).sum(), total, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("background", [False, True])
def test_what_is_mirrored_and_the_rest_is_all_light(background: bool) -> None:
    field = _field(background, Region((1.0, 2.0, 3.0), 0.5))
    camera, pose = Camera(16, 12, 12.0, 12.0, 7.5, 5.5), np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 2.2
    plain = field.render(camera, pose)
    with pytest.raises(InputError, match="no lamps"):
        render_light(field, camera, pose)
    field.light = Light(field.appearance.width, field.shader.heads.out_features)
    field.light.add(torch.tensor([[0.0, 0.0, -3.0], [2.0, 2.0, -1.0]]))
    lit = field.render(camera, pose)
    with torch.no_grad():
        field.light.second.bias[2:4] = -60.0  # nothing of the surroundings, nothing transmitted
    whole, light = field.render(camera, pose), render_light(field, camera, pose)
    for name in lit.channels:  # that is polarized light, of cameras that see it
        more = np.abs(lit.channels[name] - whole.channels[name]).max()
        assert more > 1e-3 if name in lit.stokes else more == 0.0
    for name, mirrored in light.mirrored.items():
        np.testing.assert_allclose(whole.channels[name], plain.channels[name] + mirrored, atol=1e-6, rtol=1e-5)
        assert (mirrored > 1e-3).sum() > 20 and (mirrored >= 0).all()
    hit = np.isfinite(light.roughness)
    assert hit.sum() > 20 and np.array_equal(hit, np.isfinite(light.strength))
    assert 0.02 < light.roughness[hit].min() <= light.roughness[hit].max() < 1.0 and light.strength[hit].min() > 0.0
