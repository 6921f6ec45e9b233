"""The surface of a field as a mesh: closed, outward, seamless, exact, sparing with memory, and loses nothing."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from analytic import MONO, AnalyticField, Distance, sphere, torus
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from skimage.measure import marching_cubes

from mmsynth.errors import InputError
from mmsynth.field.design import Design
from mmsynth.field.field import Field
from mmsynth.field.kernels import Sampling
from mmsynth.operations.mesh.extract import Kept, MeshOptions, extract_mesh, settle
from mmsynth.operations.mesh.marching import march, steepest
from mmsynth.operations.mesh.quality import describe_mesh
from mmsynth.scene.scene import Region

UNIT = Region((0.0, 0.0, 0.0), 1.0)


def mesh_of(distance: Distance, resolution: int = 48, block: int = 16, region: Region | None = None, **options: Any) -> trimesh.Trimesh:
    return extract_mesh(AnalyticField(distance, [MONO], region), MeshOptions(resolution, block, **options))  # type: ignore[arg-type]


def rippled(p: np.ndarray) -> np.ndarray:
    """No distance: slopes from 0.4 to 1.6, many pieces."""
    return 0.3 * (np.sin(9 * p[..., 0]) + np.sin(8 * p[..., 1] + 1) + np.cos(7 * p[..., 2])) / 3 + 0.4 * (np.linalg.norm(p, axis=-1) - 0.5)


def dense(distance: Distance, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Every lattice point evaluated, one call of scikit-image."""
    axis = np.arange(-1, n + 2) * (2.0 / n) - 1.0
    values = distance(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)).astype(np.float32)
    v, f, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
    return (v.astype(np.float64) - 1.0) * (2.0 / n) - 1.0, f


def crossed(vertices: np.ndarray, n: int) -> set[tuple[int, ...]]:
    """Lattice edges well inside the ball that have a vertex."""
    at = (vertices + 1) * n / 2
    low = np.floor(at + 1e-9)
    edge = np.concatenate([low, at - low > 1e-6], 1)[np.linalg.norm(low * 2 / n - 1, axis=1) < 0.9]
    return {tuple(row) for row in edge.astype(int)}


@pytest.mark.parametrize(
    ("distance", "euler", "volume", "area"),
    [
        (sphere(0.6), 2, 4 / 3 * np.pi * 0.6**3, 4 * np.pi * 0.6**2),
        (torus(), 0, 2 * np.pi**2 * 0.5 * 0.2**2, 4 * np.pi**2 * 0.5 * 0.2),
    ],
)
@pytest.mark.parametrize(("resolution", "block"), [(48, 16), (50, 16), (48, 7), (96, 64)])
def test_closed_outward_and_exact(distance: Distance, euler: int, volume: float, area: float, resolution: int, block: int) -> None:
    mesh = mesh_of(distance, resolution, block)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == euler
    assert mesh.volume == pytest.approx(volume, rel=0.015 * (48 / resolution) ** 2)  # positive: outward
    assert mesh.area == pytest.approx(area, rel=0.015 * (48 / resolution) ** 2)
    assert np.abs(distance(mesh.vertices)).max() < 1e-3 * 2 / resolution
    outward = np.einsum("vi,vi->v", mesh.vertex_normals, AnalyticField(distance).normal(mesh.vertices))
    assert outward.min() > 0.995  # differences of a cell


def test_blocks_leave_no_trace() -> None:
    one, many = mesh_of(torus(), 48, 50), mesh_of(torus(), 48, 7)
    assert np.array_equal(one.faces[np.lexsort(one.faces.T)], many.faces[np.lexsort(many.faces.T)])
    assert np.array_equal(one.vertices, many.vertices)  # vertices come in the order of their lattice edges


@pytest.mark.parametrize("n", [24, 48, 64])
@pytest.mark.parametrize("distance", [rippled, torus(), sphere(0.6)])
def test_no_part_of_the_dense_surface_is_lost(distance: Distance, n: int) -> None:
    v, _ = march(distance, UNIT, n, 16)
    whole, _ = dense(distance, n)
    assert crossed(v, n) == crossed(whole, n) and len(crossed(v, n)) > 500


@pytest.mark.parametrize("seed", range(3))
def test_no_part_of_a_learned_field_is_lost(seed: int) -> None:
    """A network on a hash grid with random features: no distance, steep and flat, pieces everywhere."""
    n = 64
    design = Design(surface_levels=3, surface_finest=24, coarsest=6, radiance_levels=1, radiance_finest=4, initial_radius=0.5)
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        field = Field(design, {"mono": MONO}, {"mono": 0.5}, UNIT)
        field.surface.grid.table.uniform_(-0.6, 0.6)
        field.surface.output_weight[:-1].uniform_(-0.6, 0.6)
    field.sampling = Sampling(20.0, 0.05, 3, 1)
    v, _ = march(field.sdf, UNIT, n, 16)
    whole, _ = dense(lambda p: field.sdf(p.reshape(-1, 3)).reshape(p.shape[:-1]), n)
    assert crossed(v, n) == crossed(whole, n) and len(crossed(v, n)) > 5000
    closed = extract_mesh(field, MeshOptions(n, 16, keep="all", closed=True))
    assert closed.is_watertight and closed.body_count > 3


@settings(max_examples=15, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-0.35, 0.35)] * 3, st.floats(0.02, 0.3)), min_size=1, max_size=5),
    st.integers(20, 40),
    st.integers(5, 48),
)
@example(balls=[(0.0, 0.0, -0.28, 0.03)], n=20, block=5)
def test_any_balls_are_closed_and_none_is_lost(balls: list[tuple[float, float, float, float]], n: int, block: int) -> None:
    def union(p: np.ndarray) -> np.ndarray:
        return np.min([np.linalg.norm(p - np.array(c[:3]), axis=-1) - c[3] for c in balls], axis=0)

    axis = np.arange(-1, n + 2) * 2 / n - 1
    least = union(np.stack(np.meshgrid(axis, axis, axis), -1)).min()
    assume(abs(least) > 1e-12)  # a ball that touches one point of the lattice is there or not by how its place is rounded
    if least > 0:
        with pytest.raises(InputError, match="no surface"):
            mesh_of(union, n, block, keep="all")
        return
    mesh = mesh_of(union, n, block, keep="all")
    assert mesh.is_watertight and mesh.volume > 0
    assert np.abs(union(mesh.vertices)).max() < 0.5 * 2 / n
    whole_v, whole_f = dense(union, n)
    assert len(mesh.split()) == len(trimesh.Trimesh(whole_v, whole_f, process=False).split(only_watertight=False))


def test_ruling_out_does_not_depend_on_the_scale_of_the_values() -> None:
    one, steep = mesh_of(torus()), mesh_of(lambda p: 1000.0 * torus()(p))
    assert len(one.faces) == len(steep.faces)
    assert np.abs(one.vertices - steep.vertices).max() < 1e-5


def test_the_slope_is_bounded() -> None:
    assert 1.0 <= steepest(sphere(0.5), UNIT, 0.02) <= 1.3
    assert 3.0 <= steepest(lambda p: 3.0 * p[..., 0], UNIT, 0.02) <= 3.8


def test_a_block_boundary_exactly_on_the_surface() -> None:
    """Faces of a cube on lattice planes that are block boundaries: every value there is exactly 0, and usual marching cubes collapse."""

    def cube(p: np.ndarray) -> np.ndarray:
        return np.abs(p).max(-1) - 0.5

    for block in (8, 9, 25):  # the lattice begins a cell before the region: 9 and 25 end blocks on the cube
        mesh = mesh_of(cube, 32, block)
        assert mesh.is_watertight and mesh.euler_number == 2 and mesh.area_faces.min() > 0
        assert mesh.volume == pytest.approx(1.0, rel=3e-2)  # its edges are cut off


def test_values_that_depend_on_the_batch_leave_no_seam() -> None:
    """A network's last bits depend on the batch that a point is in; here they even change the sign at the surface."""
    calls = itertools.count()

    def noisy(p: np.ndarray) -> np.ndarray:
        return np.abs(p).max(-1) - 0.5 + 1e-4 * (-1.0) ** next(calls)

    assert mesh_of(noisy, 32, 8).is_watertight


def test_a_sheet_thinner_than_a_cell_is_cut_where_it_falls_between_and_stays_closed() -> None:
    """A tilted slab of a third of a cell: what of it holds lattice points is there, and closed; the rest cannot show."""
    n = 48
    slab = lambda p: np.maximum(np.abs(p @ np.array([0.1, 0.2, 0.9746794])) - 0.17 * 2 / n, np.linalg.norm(p, axis=-1) - 0.7)
    mesh = mesh_of(slab, n, 16, keep="all")
    assert mesh.is_watertight and mesh.volume > 0
    assert np.abs(mesh.vertices @ np.array([0.1, 0.2, 0.9746794])).max() < 2 / n
    finer = mesh_of(slab, 4 * n, 16)
    assert finer.is_watertight and finer.euler_number == 2
    assert finer.volume == pytest.approx(np.pi * 0.7**2 * 0.34 * 2 / n, rel=0.1)


def test_memory_follows_the_block() -> None:
    fields = {n: AnalyticField(sphere(0.6), [MONO]) for n in (64, 256)}
    for n, field in fields.items():
        extract_mesh(field, MeshOptions(n, 16))  # type: ignore[arg-type]
    asked = {n: field.points for n, field in fields.items()}
    assert asked[256] < 24 * asked[64]  # 4² times the surface, not 4³ times the volume
    assert asked[256] < 0.5 * 257**3


def test_world_frame() -> None:
    centre = (10.0, -3.0, 2.0)
    mesh = mesh_of(sphere(0.1, centre), region=Region(centre, 0.25))
    assert np.linalg.norm(mesh.vertices - centre, axis=1) == pytest.approx(0.1, abs=1e-5)
    assert mesh.metadata["unit"] == "m"


def plane(p: np.ndarray) -> np.ndarray:
    return p[..., 2] - 0.1 * p[..., 0]


def test_a_plane_that_cuts_the_border_stays_open() -> None:
    mesh = mesh_of(plane)
    report = describe_mesh(mesh)
    assert not report["watertight"] and report["volume"] is None and report["boundary_edges"] > 50
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 1 + 2 * 2 / 48  # nothing outside
    assert np.average(mesh.face_normals, 0, mesh.area_faces) @ [-0.1, 0, 1] > 0.99
    assert mesh.area == pytest.approx(np.pi, rel=0.03)


def test_a_plane_that_cuts_the_border_is_closed_on_request() -> None:
    for resolution, block in ((48, 16), (47, 9)):
        mesh = mesh_of(plane, resolution, block, closed=True)
        assert mesh.is_watertight and mesh.euler_number == 2
        assert mesh.volume == pytest.approx(2 / 3 * np.pi, rel=0.01)  # half the ball, below
        assert np.linalg.norm(mesh.vertices, axis=1).max() < 1 + 1e-3 * 2 / resolution


def test_everything_inside() -> None:
    """A solid region: no surface of its own, and closed it is the ball."""
    with pytest.raises(InputError, match="no surface"):
        mesh_of(lambda p: np.full(p.shape[:-1], -1.0))
    ball = mesh_of(lambda p: np.full(p.shape[:-1], -3.0), 48, 16, closed=True)
    assert ball.is_watertight and ball.euler_number == 2
    assert ball.volume == pytest.approx(4 / 3 * np.pi, rel=0.01)


@pytest.mark.parametrize("closed", [False, True])
def test_an_empty_field(closed: bool) -> None:
    with pytest.raises(InputError, match="no surface in the region"):
        mesh_of(lambda p: np.full(p.shape[:-1], 1.0), closed=closed)


def test_not_a_number_is_said_and_not_meshed() -> None:
    with pytest.raises(InputError, match=r"distance at .* is nan"):
        mesh_of(lambda p: np.where(p[..., 0] > 0.5, np.nan, sphere()(p)))


def three(p: np.ndarray) -> np.ndarray:
    return np.minimum(np.minimum(sphere(0.5)(p), sphere(0.1, (0.75, 0.0, 0.0))(p)), sphere(0.012, (-0.8, 0.0, 0.0))(p))


@pytest.mark.parametrize(("keep", "bodies"), [("all", 3), ("clean", 2), ("largest", 1), (2, 2), (9, 3)])
def test_components_by_size(keep: Kept | int, bodies: int) -> None:
    mesh = mesh_of(three, 96, 32, keep=keep)
    assert mesh.body_count == bodies == describe_mesh(mesh)["components"]
    assert np.abs(mesh.vertices).min(0).max() < 0.5 and np.linalg.norm(mesh.vertices, axis=1).max() < 0.9


def test_newton_steps_reach_the_zero_and_never_leave_it() -> None:
    rng = np.random.default_rng(0)
    start = rng.normal(size=(500, 3))
    start *= (0.6 + rng.uniform(-0.03, 0.03, (500, 1))) / np.linalg.norm(start, axis=1, keepdims=True)
    for distance in (sphere(0.6), lambda p: 40.0 * sphere(0.6)(p)):
        found = settle(distance, start, 0.04)
        assert np.abs(np.linalg.norm(found, axis=1) - 0.6).max() < 1e-5
        assert np.linalg.norm(found - start, axis=1).max() < 0.031  # along the normal
    flat = settle(lambda p: np.full(len(p), 0.5), start, 0.04)
    assert np.array_equal(flat, start)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": 1}, "resolution 1"),
        ({"block": 1}, "block 1"),
        ({"keep": "some"}, "'some'"),
        ({"keep": "0"}, "'0'"),
        ({"min_views": 2}, "needs a scene"),
        ({"faces": 100, "max_error": 0.1}, "one of"),
        ({"faces": 3}, "3 faces"),
        ({"max_error": 0.0}, "above 0"),
        ({"max_error": float("nan")}, "above 0"),
    ],
)
def test_bad_arguments(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        mesh_of(sphere(), **options)
