"""Hard cases of marching cubes, on a field that is exactly a ball."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
from skimage.measure import marching_cubes

from mmsynth.errors import InputError
from mmsynth.field.design import Design
from mmsynth.field.field import Field
from mmsynth.operations.mesh.extract import MeshOptions, extract_mesh
from mmsynth.scene.scene import Region, Sensor

Row = Callable[[str, str, str], None]


UNIT = Region((0.0, 0.0, 0.0), 1.0)


def _ball(radius: float, region: Region = UNIT) -> Field:
    design = Design(
        surface_levels=1, radiance_levels=1, surface_finest=4, radiance_finest=4, coarsest=4, occupancy=16, initial_radius=radius
    )
    return Field(design, {"grey": Sensor("grey", ("L",), (None,))}, {"grey": 1.0}, region)


def _distances(axis: np.ndarray, radius: float) -> np.ndarray:
    """Signed distances to a ball on the lattice that has this axis three times."""
    return (np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1) - radius).astype(np.float32)


@pytest.mark.parametrize("radius", [0.5, 0.25])
def test_a_surface_through_lattice_points(row: Row, radius: float) -> None:
    """The poles and others lie on lattice points: values of exactly 0."""
    n = 16
    v, f, _, _ = marching_cubes(_distances(np.linspace(-1, 1, n + 1), radius), 0.0)
    collapsed = int((np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1) < 1e-9).sum())
    assert collapsed > 0
    mesh = extract_mesh(_ball(radius), MeshOptions(n, 8))
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.area_faces.min() > 0
    row(f"a ball of {radius} through lattice points", f"{collapsed} triangles without area", "closed, every triangle with an area")


def test_where_a_surface_is_and_which_way_it_faces(row: Row) -> None:
    """Half a cell off, inside out: the usual two mistakes. World frame, off the origin, in any unit."""
    region = Region((300.0, -20.0, 5.0), 1000.0)
    mesh = extract_mesh(_ball(0.5, region), MeshOptions(64, 32))
    distance = np.linalg.norm(mesh.vertices - np.array(region.centre), axis=1)
    off = np.abs(distance - 500.0).max()
    outward = np.einsum("fi,fi->f", mesh.face_normals, mesh.triangles_center - np.array(region.centre))
    assert off < 1.0 and (outward > 0).all() and mesh.volume > 0
    # values at the middles of cells, placed as if they were at their corners; and the level of -sdf
    centres = _distances((np.arange(64) + 0.5) / 32 - 1, 0.5)
    v, f, _, _ = marching_cubes(centres, 0.0)
    shifted = np.abs(1000 * np.linalg.norm(v / 32 - 1, axis=1) - 500).max()
    v, f, _, _ = marching_cubes(-centres, 0.0)
    volume = trimesh.Trimesh(v / 32, f, process=False).volume
    assert shifted > 15 and volume < 0
    row(
        "a ball of 500 mm on a lattice of 31 mm",
        f"values of cell centres at v / n: up to {shifted:.0f} mm off; of -sdf: a volume of {volume:.2f} m³",
        f"{off:.2g} mm off, outward, {mesh.volume / 1e9:.2f} m³",
    )


def test_the_lattice_is_finer_than_half_precision(row: Row) -> None:
    """Points next to a surface, of MultimodalStudio's lattice: 2048 across, in crops of 256 that share their planes."""
    axis, cell = np.concatenate([np.linspace(a, a + 0.25, 256) for a in np.arange(-1, 1, 0.25)]), 0.25 / 255
    outward = np.random.default_rng(0).normal(size=(2000, 3))
    near = 0.97 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
    points = axis[np.abs(near[..., None] - axis).argmin(-1)]
    truth = np.linalg.norm(points, axis=1) - 0.97
    usual = np.abs(np.linalg.norm(points.astype(np.float16).astype(np.float64), axis=1) - 0.97 - truth).max() / cell
    ours = np.abs(_ball(0.97).sdf(points) - truth).max() / cell
    assert usual > 0.2 and ours < 1e-3
    row(
        "distances at the points of a mesh of 2048 cells across",
        f"MultimodalStudio's points in half precision: up to {usual:.2f} cells off",
        f"{ours:.0e} cells off",
    )


def test_blocks_and_the_border_leave_no_holes(row: Row) -> None:
    """The surface crosses many blocks, and comes near the lattice's own border."""
    mesh = extract_mesh(_ball(0.97), MeshOptions(48, 7))
    assert mesh.is_watertight and len(mesh.split(only_watertight=False)) == 1
    # blocks that share their planes, each marched alone and put together, as MultimodalStudio and sdfstudio do
    values, parts = _distances(np.linspace(-1, 1, 50), 0.97), []
    for i, j, k in np.ndindex(7, 7, 7):
        block = values[7 * i : 7 * i + 8, 7 * j : 7 * j + 8, 7 * k : 7 * k + 8]
        if block.min() < 0 < block.max():
            parts.append(trimesh.Trimesh(*marching_cubes(block, 0.0)[:2], process=False).apply_translation([7 * i, 7 * j, 7 * k]))
    together = trimesh.util.concatenate(parts)
    pieces = len(together.split(only_watertight=False))
    assert not together.is_watertight and pieces > 50
    row("seven blocks along each axis", f"each marched alone, put together: {pieces} open pieces", "one closed piece")


@pytest.mark.parametrize("level", [5.0, -5.0])
def test_no_surface_is_said(row: Row, level: float) -> None:
    field = _ball(0.5)
    with torch.no_grad():
        field.surface.output_weight[-1] = level
    with pytest.raises(InputError, match="no surface in the region"):
        extract_mesh(field, MeshOptions(16, 8))
    with pytest.raises(ValueError, match="within volume data range"):
        marching_cubes(np.full((17, 17, 17), level, np.float32), 0.0)
    row(
        "a field that is all " + ("empty" if level > 0 else "solid"),
        "scikit-image: ValueError, level not in range",
        "refused in one sentence",
    )
