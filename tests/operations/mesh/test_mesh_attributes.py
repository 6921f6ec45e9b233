"""What is on the vertices: closed forms of a ball under a known light, what each view may see, and polarization in world space."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from analytic import MONO, MS, POL, RGB, AnalyticField, ring_pose, scene_of, sphere
from conftest import look_at
from hypothesis import given
from hypothesis import strategies as st

from mmsynth.errors import InputError
from mmsynth.operations.mesh.attributes import View, add_attributes, coarse, depth_maps, polarized_part, training_views, views_that_see
from mmsynth.operations.mesh.extract import MeshOptions, extract_mesh
from mmsynth.operations.mesh.files import write_mesh
from mmsynth.scene.scene import PosedCamera, Scene, Split
from mmsynth.sensors.camera import Camera, project, ray_map
from mmsynth.sensors.polarization import stokes_to_coherency

CELL = 2 / 40
FINE = Camera(96, 72, 104.0, 104.0, 46.7, 35.9, (-0.1, 0.05, 0.001, -0.002))


def hollow(p: np.ndarray) -> np.ndarray:
    """A thick shell with a ball inside: nobody sees that, nor the shell's inner side."""
    shell = np.abs(sphere(0.5)(p)) - 0.04
    return np.minimum(shell, sphere(0.12)(p))


@pytest.fixture(scope="module")
def baked(tmp_path_factory: pytest.TempPathFactory) -> tuple[trimesh.Trimesh, AnalyticField, Scene]:
    field = AnalyticField(sphere(0.6), (RGB, MS, POL, MONO))
    field.cameras = dict.fromkeys(field.cameras, FINE)
    scene = scene_of(field, tmp_path_factory.mktemp("scene"), views=9)
    mesh = extract_mesh(field, MeshOptions(40), scene=scene)  # type: ignore[arg-type]
    return mesh, field, scene


def shade(normals: np.ndarray) -> np.ndarray:
    light = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    return 0.15 + 0.6 * np.clip(normals @ light, 0, None)


def test_every_channel_is_there_and_right(baked: tuple[trimesh.Trimesh, AnalyticField, Scene]) -> None:
    mesh, field, _ = baked
    values = mesh.vertex_attributes
    expected = [f"{s.name}_{i}" for s in (RGB, MS, MONO) for i in range(s.channel_count)]
    assert set(expected) | {f"pol_{x}" for x in ("s0", "dolp", "axis_x", "axis_y", "axis_z", "axis_share")} <= set(values)
    assert set(mesh.metadata["properties"]) == set(values)
    assert "wavelength_nm 572" in mesh.metadata["properties"]["ms_3"] and "wavelength" not in mesh.metadata["properties"]["ms_8"]
    seen = values["confidence"] > 0
    assert 0.5 < seen.mean() < 1.0  # nobody looks from below
    truth = shade(field.normal(mesh.vertices))
    for sensor in (RGB, MS, MONO):
        for i, gain in enumerate(np.linspace(1.0, 0.5, sensor.channel_count)):
            assert np.abs(values[f"{sensor.name}_{i}"] - truth * gain)[seen].max() < 0.02
    assert np.abs(values["pol_s0"] - truth)[seen].max() < 0.02
    assert all(value.dtype == np.float32 and len(value) == len(mesh.vertices) for value in values.values())


def test_where_surfaces_mirror_vertices_have_a_base_colour_and_a_roughness(tmp_path: Path) -> None:
    """A quarter of the light in every channel is a lamp's image. glTF's material has the roughness; its colours are without the image."""
    made = {}
    for mirrored in (0.0, 0.25):
        field = AnalyticField(sphere(0.6), (RGB, POL), mirrored=mirrored)
        scene = scene_of(field, tmp_path / f"{mirrored}", views=5)
        made[mirrored] = extract_mesh(field, MeshOptions(24), scene=scene)  # type: ignore[arg-type]
    values, more = made[0.25].vertex_attributes, {"roughness", "strength", "pol_base_s0", *(f"rgb_base_{i}" for i in range(3))}
    assert set(values) - set(made[0.0].vertex_attributes) == more and set(made[0.25].metadata["properties"]) == set(values)
    seen = values["confidence"] > 0
    for base, whole, rest in (("rgb_base_1", "rgb_1", 0.5 / 0.75), ("pol_base_s0", "pol_s0", 0.75)):
        assert values[base][seen] == pytest.approx(rest * values[whole][seen], rel=1e-4) and np.isnan(values[base][~seen]).all()
    assert values["roughness"][seen] == pytest.approx(0.25) and values["strength"][seen] == pytest.approx(2.0)
    plain, base = (np.asarray(made[m].visual.vertex_colors)[seen, :3].astype(int) for m in (0.0, 0.25))  # type: ignore[attr-defined]
    assert (base[:, 2] / base[:, 0] < plain[:, 2] / plain[:, 0] - 0.05).all()  # what is left has more of the paint's colour
    write_mesh(made[0.25], tmp_path / "mesh.glb")
    material = trimesh.load_mesh(tmp_path / "mesh.glb").visual.material
    assert (material.roughnessFactor, material.metallicFactor) == (pytest.approx(0.5), 0.0)


def test_what_nobody_sees_is_not_a_number_and_grey(baked: tuple[trimesh.Trimesh, AnalyticField, Scene]) -> None:
    mesh, _, _ = baked
    values = mesh.vertex_attributes
    hidden = values["views"] == 0
    assert hidden.any() and (mesh.vertices[hidden, 2] < 0.1).all()
    assert np.isnan(values["rgb_0"][hidden]).all() and np.isnan(values["pol_axis_x"][hidden]).all()
    assert (values["confidence"][hidden] == 0).all() and (values["confidence"] <= 1).all()
    colours: Any = mesh.visual
    assert (np.asarray(colours.vertex_colors)[hidden] == [128, 128, 128, 255]).all()
    lit = np.asarray(colours.vertex_colors)[~hidden & (mesh.vertices[:, 2] > 0.4)]
    assert (lit[:, :3].max(1) > 100).all()


def test_polarization_is_of_the_light_and_in_the_world(baked: tuple[trimesh.Trimesh, AnalyticField, Scene]) -> None:
    mesh, _, _ = baked
    values = mesh.vertex_attributes
    seen = values["confidence"] > 0
    assert values["pol_dolp"][seen] == pytest.approx(0.3, abs=1e-4)  # DoLP is 0.3 in every view, whatever the axes do
    axis = np.stack([values[f"pol_axis_{c}"] for c in "xyz"], -1)[seen]
    assert np.linalg.norm(axis, axis=1) == pytest.approx(1.0, abs=1e-5)
    share = values["pol_axis_share"][seen]
    assert share.min() >= 1 / 3 - 1e-5 and share.max() <= 1 + 1e-5


def test_the_light_does_not_depend_on_how_cameras_are_rolled(baked: tuple[trimesh.Trimesh, AnalyticField, Scene]) -> None:
    """The field's polarization follows the surface; a roll turns only the numbers S1 and S2 that a camera gives it."""
    mesh, field, scene = baked
    roll = np.eye(4)
    roll[:2, :2] = [[0, -1], [1, 0]]
    frames = tuple(replace(f, camera_to_world=f.camera_to_world @ roll) for f in scene.frames)
    turned = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.vertex_normals, process=False)
    add_attributes(turned, field, replace(scene, frames=frames), CELL)  # type: ignore[arg-type]
    a, b = (np.stack([m.vertex_attributes[f"pol_axis_{c}"] for c in "xyz"], -1) for m in (mesh, turned))
    both = np.isfinite(a).all(1) & np.isfinite(b).all(1) & (mesh.vertex_attributes["pol_axis_share"] > 0.8)
    assert both.sum() > 100
    assert np.median(np.abs(np.einsum("vi,vi->v", a[both], b[both]))) > 0.98


@given(st.floats(0, 1), st.floats(-3.1, 3.1), st.floats(0.1, 2.0), st.integers(0, 100))
def test_the_polarized_part_is_the_tensor_of_the_fully_polarized_light(degree: float, twice: float, s0: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(1, 3))
    d /= np.linalg.norm(d)
    camera_x = np.cross(d[0], rng.normal(size=3))
    camera_x /= np.linalg.norm(camera_x)
    s1, s2 = s0 * degree * np.cos([twice]), s0 * degree * np.sin([twice])
    found = polarized_part(s1, s2, d, camera_x)
    y = np.cross(camera_x, d[0])
    stokes = torch.tensor([[s0 * degree, s1[0], s2[0]]], dtype=torch.float64)
    exact = stokes_to_coherency(stokes, torch.from_numpy(camera_x)[None], torch.from_numpy(y)[None]).numpy()
    assert np.abs(found - exact).max() < 1e-12
    e = np.cos(twice / 2) * camera_x + np.sin(twice / 2) * y
    assert np.abs(found[0] - s0 * degree * np.outer(e, e)).max() < 1e-12


def test_a_view_sees_what_faces_it_in_its_image_and_is_not_behind(tmp_path: Path) -> None:
    field = AnalyticField(sphere(0.6), (MONO,))
    camera, pose = FINE, ring_pose(0, 4)
    view = View(PosedCamera(camera, pose), field.render(camera, pose, []).depth_ray)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2000, 3))
    points *= 0.6 / np.linalg.norm(points, axis=1, keepdims=True)
    cosine = view.sees(points, points / 0.6)
    to_camera = pose[:3, 3] - points
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    true = np.einsum("ni,ni->n", to_camera, points / 0.6)
    # of a ball, what faces a camera is seen
    assert (cosine[true < 0.1] == 0).all() and (cosine[true > 0.3] > 0).all()
    assert np.abs(cosine - true)[cosine > 0].max() < 1e-12
    assert not view.sees(points * 0.8, points / 0.6).any()  # inside
    assert not view.sees(points, np.full_like(points, np.nan)).any()
    beside = View(PosedCamera(camera, look_at((2.2, 0.0, 1.0), (2.2, 3.0, 1.0))), view.depth_ray)
    assert not beside.sees(points, points / 0.6).any()


def test_small_cameras_look_the_same_way() -> None:
    camera = Camera(1000, 700, 900.0, 880.0, 510.0, 340.0, (-0.1, 0.02, 1e-3, 0.0))
    view = coarse(PosedCamera(camera, np.eye(4)))
    small = view.camera
    assert (small.width, small.height) == (160, 112) and coarse(view).camera == small
    rays = ray_map(small)[0][::20, ::20].reshape(-1, 3)
    at, fine = project(rays, small), project(rays, camera)
    assert np.abs((at + 0.5) * [1000 / 160, 700 / 112] - 0.5 - fine).max() < 1e-6


def test_components_by_visibility(tmp_path: Path) -> None:
    field = AnalyticField(hollow, (MONO,))
    field.cameras = {"mono": FINE}
    scene = scene_of(field, tmp_path, views=6, truth=False)
    every = extract_mesh(field, MeshOptions(48, keep="all"))  # type: ignore[arg-type]
    assert every.body_count == 3  # the shell outside and inside, and the ball in it
    seen = extract_mesh(field, MeshOptions(48, keep="all", attributes=False, min_views=2), scene=scene)  # type: ignore[arg-type]
    assert seen.body_count == 1 and np.linalg.norm(seen.vertices, axis=1).min() > 0.53
    assert not seen.vertex_attributes
    with pytest.raises(InputError, match="at most the 5 training views"):
        extract_mesh(field, MeshOptions(48, min_views=6), scene=scene)  # type: ignore[arg-type]
    away = replace(scene, frames=tuple(replace(f, camera_to_world=look_at((2.0, 0.0, 0.0), (4.0, 0.0, 0.0))) for f in scene.frames))
    with pytest.raises(InputError, match=r"no surface .* that 1 training views see"):
        extract_mesh(field, MeshOptions(48, min_views=1), scene=away)  # type: ignore[arg-type]


def test_attributes_are_asked_at_the_final_vertices(tmp_path: Path) -> None:
    field = AnalyticField(sphere(0.6), (MONO,))
    scene = scene_of(field, tmp_path, views=6, truth=False)
    mesh = extract_mesh(field, MeshOptions(48, faces=600), scene=scene)  # type: ignore[arg-type]
    assert len(mesh.faces) == 600 and np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.6).max() < 1e-5
    seen = mesh.vertex_attributes["confidence"] > 0
    assert np.abs(mesh.vertex_attributes["mono_0"] - shade(field.normal(mesh.vertices)))[seen].max() < 0.02


def test_views_are_one_place_of_the_rig_each(tmp_path: Path) -> None:
    field = AnalyticField(sphere(0.6), (RGB, MONO))
    scene = scene_of(field, tmp_path, views=5, truth=False)
    without = replace(scene, frames=tuple(f for f in scene.frames if (f.sensor, f.view) != ("rgb", 1)))
    views = training_views(field, without)  # type: ignore[arg-type]
    assert len(views) == 4
    assert np.array_equal(views[0].camera_to_world, ring_pose(0, 5) @ field.rig["rgb"])
    assert np.array_equal(views[1].camera_to_world, ring_pose(1, 5) @ field.rig["mono"])  # the first sensor that has the view
    maps = depth_maps(field, without)  # type: ignore[arg-type]
    assert views_that_see(maps, np.array([[0.0, 0.0, 0.6]]), np.array([[0.0, 0.0, 1.0]])).astype(bool).all()
    with pytest.raises(InputError, match="no training views"):
        training_views(field, replace(scene, split=Split((), (0,), "")))  # type: ignore[arg-type]
