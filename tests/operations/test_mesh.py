"""Marching cubes over blocks: closed, outward, seamless, exact, and sparing with memory."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from analytic import MONO, AnalyticField, Distance, sphere, torus

from mmsynth.errors import InputError
from mmsynth.operations.mesh import extract_mesh, write_mesh
from mmsynth.scene.scene import Region


def mesh_of(
    distance: Distance, resolution: int = 48, block: int = 16, keep: str = "clean", region: Region | None = None
) -> trimesh.Trimesh:
    return extract_mesh(AnalyticField(distance, [MONO], region), resolution, block, keep)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("distance", "euler", "volume"), [(sphere(0.6), 2, 4 / 3 * np.pi * 0.6**3), (torus(), 0, 2 * np.pi**2 * 0.5 * 0.2**2)]
)
@pytest.mark.parametrize(("resolution", "block"), [(48, 16), (50, 16), (48, 7), (48, 64)])
def test_closed_outward_and_exact(distance: Distance, euler: int, volume: float, resolution: int, block: int) -> None:
    mesh = mesh_of(distance, resolution, block)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == euler
    assert mesh.volume == pytest.approx(volume, rel=0.01)  # positive: outward
    assert np.abs(distance(mesh.vertices)).max() < 1e-3 * 2 / resolution


def test_blocks_leave_no_trace() -> None:
    one, many = mesh_of(torus(), 48, 48), mesh_of(torus(), 48, 7)
    assert len(one.faces) == len(many.faces)
    assert np.array_equal(one.vertices, many.vertices)  # vertices come in the order of their lattice edges


def test_surface_through_lattice_points() -> None:
    """Faces of a cube on lattice planes: every value there is exactly 0, which makes usual marching cubes collapse triangles."""

    def cube(p: np.ndarray) -> np.ndarray:
        return np.abs(p).max(-1) - 0.5

    mesh = mesh_of(cube, 32, 8)
    assert mesh.is_watertight and mesh.volume == pytest.approx(1.0, rel=3e-2)  # its edges are cut off


def test_values_that_depend_on_the_batch_leave_no_seam() -> None:
    """A network's last bits depend on the batch that a point is in; here they even change the sign at the surface."""
    calls = itertools.count()

    def noisy(p: np.ndarray) -> np.ndarray:
        return np.abs(p).max(-1) - 0.5 + 1e-4 * (-1.0) ** next(calls)

    assert mesh_of(noisy, 32, 8).is_watertight


def test_memory_follows_the_block() -> None:
    field = AnalyticField(sphere(0.6), [MONO])
    extract_mesh(field, 96, 16)  # type: ignore[arg-type]
    assert field.largest_query <= 3 * 17**3 * 4 < 97**3


def test_world_frame() -> None:
    centre = (10.0, -3.0, 2.0)
    mesh = mesh_of(sphere(0.1, centre), region=Region(centre, 0.25))
    assert np.linalg.norm(mesh.vertices - centre, axis=1) == pytest.approx(0.1, abs=1e-5)


def test_cut_at_the_region() -> None:
    """A plane leaves the ball: open there, nothing outside."""
    mesh = mesh_of(lambda p: p[..., 2] - 0.1 * p[..., 0])
    assert not mesh.is_watertight
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 1 + 2 * 2 / 48
    assert np.average(mesh.face_normals, 0, mesh.area_faces) @ [-0.1, 0, 1] > 0.99


def test_floaters() -> None:
    def two(p: np.ndarray) -> np.ndarray:
        return np.minimum(sphere(0.6)(p), sphere(0.02, (0.8, 0.0, 0.0))(p))

    bodies = {keep: mesh_of(two, 96, 32, keep).body_count for keep in ("all", "largest")}
    assert bodies == {"all": 2, "largest": 1}
    assert mesh_of(two, 96, 32, "clean").body_count == 1


@pytest.mark.parametrize("value", [1.0, -1.0, np.nan])
def test_no_surface(value: float) -> None:
    with pytest.raises(InputError, match="no surface"):
        mesh_of(lambda p: np.full(p.shape[:-1], value))


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
def test_files(tmp_path: Path, suffix: str) -> None:
    mesh = mesh_of(sphere(), 24)
    write_mesh(mesh, tmp_path / f"mesh{suffix}", "m")
    back = trimesh.load(tmp_path / f"mesh{suffix}", force="mesh")
    assert len(back.faces) == len(mesh.faces)
    assert np.allclose(back.bounds, mesh.bounds, atol=1e-6)
    if suffix in (".ply", ".obj"):
        assert b"unit: m" in (tmp_path / f"mesh{suffix}").read_bytes()[:300]


def test_bad_arguments(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown mesh type"):
        write_mesh(trimesh.Trimesh(), tmp_path / "mesh.txt")
    for resolution, block, keep in [(1, 8, "all"), (8, 1, "all"), (8, 8, "some")]:
        with pytest.raises(InputError, match="expected"):
            mesh_of(sphere(), resolution, block, keep)
    assert not list(tmp_path.iterdir())
