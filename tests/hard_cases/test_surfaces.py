"""Hard cases of marching cubes, on a field that is exactly a ball."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from skimage.measure import marching_cubes

from mmsynth.errors import InputError
from mmsynth.field.field import Design, Field
from mmsynth.operations.mesh import extract_mesh
from mmsynth.scene.scene import Region, Sensor

Row = Callable[[str, str, str], None]


UNIT = Region((0.0, 0.0, 0.0), 1.0)


def _ball(radius: float, region: Region = UNIT) -> Field:
    design = Design(
        surface_levels=1, radiance_levels=1, surface_finest=4, radiance_finest=4, coarsest=4, occupancy=16, initial_radius=radius
    )
    return Field(design, {"grey": Sensor("grey", ("L",), (None,))}, {"grey": 1.0}, region)


@pytest.mark.parametrize("radius", [0.5, 0.25])
def test_a_surface_through_lattice_points(row: Row, radius: float) -> None:
    """The poles and others lie on lattice points: values of exactly 0."""
    n = 16
    axis = np.linspace(-1, 1, n + 1)
    values = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1) - radius
    v, f, _, _ = marching_cubes(values.astype(np.float32), 0.0)
    collapsed = int((np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1) < 1e-9).sum())
    mesh = extract_mesh(_ball(radius), n, 8)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.area_faces.min() > 0
    row(f"a ball of {radius} through lattice points", f"{collapsed} triangles without area", "closed, every triangle with an area")


def test_where_a_surface_is_and_which_way_it_faces(row: Row) -> None:
    """Half a cell off, inside out: the usual two mistakes. World frame, off the origin, in any unit."""
    region = Region((300.0, -20.0, 5.0), 1000.0)
    mesh = extract_mesh(_ball(0.5, region), 64, 32)
    distance = np.linalg.norm(mesh.vertices - np.array(region.centre), axis=1)
    off = np.abs(distance - 500.0).max()
    outward = np.einsum("fi,fi->f", mesh.face_normals, mesh.triangles_center - np.array(region.centre))
    assert off < 1.0 and (outward > 0).all() and mesh.volume > 0
    row("a ball of 500 mm on a lattice of 31 mm", "half a cell off: 16 mm; inside out", f"{off:.2g} mm off, outward")


def test_blocks_and_the_border_leave_no_holes(row: Row) -> None:
    """The surface crosses every block, and the lattice's own border."""
    mesh = extract_mesh(_ball(0.97), 48, 7)
    assert mesh.is_watertight and len(mesh.split(only_watertight=False)) == 1
    row("seven blocks along each axis", "seams between blocks, holes at the border", "one closed piece")


@pytest.mark.parametrize("level", [5.0, -5.0])
def test_no_surface_is_said(row: Row, level: float) -> None:
    field = _ball(0.5)
    with torch.no_grad():
        field.surface.last[-1] = level
    with pytest.raises(InputError, match="no surface in the region"):
        extract_mesh(field, 16, 8)
    row("a field that is all " + ("empty" if level > 0 else "solid"), "an empty list, or a crash in the merge", "refused in one sentence")
