"""The surface of a field as a triangle mesh: block-wise marching cubes on one global lattice.

Symbols: ``n`` cells along each edge of the region's bounding cube, ``h`` cell size (scene unit). Lattice point (i, j, k), integers
in 0..n, lies at ``corner + h (i, j, k)``. Everything that decides the topology hangs on the integers:

* a lattice point shared by blocks has one value (the first one computed is kept: a network's last bit may depend on its batch),
* vertices are welded by the lattice edge they lie on, never by distance,

so blocks meet without seams, and a closed surface inside the region comes out watertight. A surface that leaves the region is cut
at its ball and stays open there: what lies beyond was never learned.

Marching cubes: Lewiner et al. 2003 (scikit-image), topologically correct per cell.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from mmsynth.errors import InputError
from mmsynth.files import write_atomic

if TYPE_CHECKING:
    from mmsynth.field.field import Field

SUFFIXES = (".ply", ".obj", ".stl", ".glb")
_COARSE = 8  # cells along a coarse cell; only coarse cells near the surface are evaluated finely
_MARGIN = 1.5  # how far from a true distance (slope 1) the learned one may be when coarse cells are ruled out
_SNAP = 1e-4  # no vertex is nearer than this (in cells) to a lattice point: edges that meet there keep vertices of their own
_FLOATER = 1e-3


class _Lattice:
    """The global lattice and what is known about where the surface is."""

    def __init__(self, field: Field, resolution: int) -> None:
        self.field, self.n = field, resolution
        self.centre = np.asarray(field.region.centre, dtype=np.float64)
        self.radius = float(field.region.radius)
        self.h = 2.0 * self.radius / resolution
        self.shared: dict[tuple[int, ...], np.ndarray] = {}
        count = -(-resolution // _COARSE)
        half_diagonal = 0.5 * np.sqrt(3.0) * _COARSE * self.h
        self.coarse = np.empty((count, count, count), np.float32)
        self.active = np.empty((count, count, count), bool)
        for i in range(count):  # by slab: all centres at once would be the largest array of all
            middle = (np.stack(np.meshgrid([i], np.arange(count), np.arange(count), indexing="ij"), -1).reshape(-1, 3) + 0.5) * _COARSE
            value = self.sdf(middle)
            # a coarse cell that only touches the ball still counts
            inside = np.linalg.norm(self.world(middle) - self.centre, axis=1) < self.radius + half_diagonal
            self.coarse[i] = value.reshape(count, count)
            self.active[i] = ((np.abs(value) < _MARGIN * half_diagonal) & inside).reshape(count, count)

    def world(self, lattice: np.ndarray) -> np.ndarray:
        """Lattice coordinates (..., 3) → world."""
        return self.centre - self.radius + lattice * self.h

    def sdf(self, lattice: np.ndarray) -> np.ndarray:
        """Lattice coordinates (N, 3) → (N,) float32 signed distance, never exactly 0; NaN counts as outside."""
        value = np.asarray(self.field.sdf(self.world(lattice)), dtype=np.float32)
        tiny = np.float32(_SNAP * self.h)
        value = np.where(np.isnan(value), np.float32(self.radius), value)
        return np.where(np.abs(value) < tiny, np.where(value < 0, -tiny, tiny), value)

    def block(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Values at the lattice points ``low..high`` (both included), float32; far from the surface, the coarse value."""
        values, wanted = self.coarse, self.active
        for axis in range(3):
            points = np.arange(low[axis], high[axis] + 1)
            last = values.shape[axis] - 1
            after = np.minimum(points // _COARSE, last)
            before = np.maximum(points - 1, 0) // _COARSE
            values = values.take(after, axis)
            wanted = wanted.take(before, axis) | wanted.take(after, axis)
        values = values.copy()
        values[wanted] = self.sdf(np.argwhere(wanted) + low)
        return values

    def agree(self, values: np.ndarray, index: tuple[int, ...]) -> None:
        """Give lattice points on the hull of block ``index`` the values that earlier blocks have for them."""
        sides = (slice(0, 1), slice(1, -1), slice(-1, None))
        for place in itertools.product(range(3), repeat=3):
            if place == (1, 1, 1):
                continue
            part = tuple(sides[p] for p in place)
            key = tuple(2 * i + p for i, p in zip(index, place, strict=True))  # the same face, edge or corner in any block
            known = self.shared.setdefault(key, values[part].copy())
            values[part] = known


def _refine(lattice: _Lattice, vertices: np.ndarray, rounds: int = 4) -> np.ndarray:
    """Move vertices along their lattice edge to the zero of the field: regula falsi with Illinois weights, always inside the bracket.

    Linear interpolation is off by the curvature within a cell; a few evaluations per vertex remove that.

    Args:
        vertices: (V, 3) float64 lattice coordinates; those inside a cell (on no edge) stay.
    """
    floor = np.floor(vertices)
    fraction = vertices - floor
    rows = np.flatnonzero((fraction > 0).sum(1) == 1)
    axis = fraction[rows].argmax(1)
    low = floor[rows]
    step = np.eye(3)[axis]
    t0, t1 = np.zeros(len(rows)), np.ones(len(rows))
    f0, f1 = lattice.sdf(low).astype(np.float64), lattice.sdf(low + step).astype(np.float64)
    bracketed = (f0 < 0) != (f1 < 0)
    # from the end values and not from the vertex, whose last digits depend on the block it came from
    t = np.where(bracketed, f0 / np.where(bracketed, f0 - f1, 1.0), fraction[rows, axis])
    before: np.ndarray | None = None
    for _ in range(rounds):
        ft = lattice.sdf(low + t[:, None] * step).astype(np.float64)
        left = (ft < 0) == (f0 < 0)  # t lies on the side of t0
        again = np.zeros_like(left) if before is None else left == before  # an end that stays twice counts half
        f0, f1 = np.where(left, ft, np.where(again, 0.5 * f0, f0)), np.where(left, np.where(again, 0.5 * f1, f1), ft)
        t0, t1 = np.where(left, t, t0), np.where(left, t1, t)
        before = left
        slope = np.where(f1 != f0, f1 - f0, 1.0)
        t = np.where(bracketed, t0 - f0 * (t1 - t0) / slope, t)
    out = vertices.copy()
    out[rows, axis] = low[np.arange(len(rows)), axis] + np.clip(t, _SNAP, 1 - _SNAP)
    return out


def _weld(vertices: np.ndarray, faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices on the same lattice edge (or inside the same cell), (V, 3) lattice coordinates."""
    floor = np.floor(vertices).astype(np.int64)
    key = 2 * floor + (vertices > floor)
    size = 2 * (n + 2)
    flat = (key[:, 0] * size + key[:, 1]) * size + key[:, 2]
    _, first, inverse = np.unique(flat, return_index=True, return_inverse=True)
    return vertices[first], inverse.reshape(-1)[faces]


def _components(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """(F,) component number of each face; faces that share a vertex belong together."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(vertex_count, vertex_count))
    return connected_components(graph, directed=False)[1][faces[:, 0]]


def _keep(faces: np.ndarray, vertex_count: int, keep: str) -> np.ndarray:
    if keep == "all" or not len(faces):
        return faces
    component = _components(faces, vertex_count)
    size = np.bincount(component)[component]
    return faces[size == size.max()] if keep == "largest" else faces[size >= _FLOATER * len(faces)]


def extract_mesh(
    field: Field, resolution: int = 256, block: int = 64, keep: str = "clean", progress: Callable[[int, int], None] | None = None
) -> trimesh.Trimesh:
    """The field's zero level inside its region of interest.

    Args:
        resolution: cells along the diameter of the region; the cell is the smallest thing that can show.
        block: cells along a block. Memory grows with block³ and with the surface, not with resolution³.
        keep: "clean" drops floaters (components below 1e-3 of the faces), "largest" keeps one component, "all" keeps everything.
        progress: called with (blocks done, blocks in all).
    Returns:
        mesh in the scene's world frame and unit, faces counter-clockwise seen from outside, nothing merged or dropped by trimesh.
    Raises:
        InputError: bad argument, or no surface in the region.
    """
    if resolution < 2 or block < 2:
        raise InputError(f"mesh: resolution {resolution} and block {block}, expected whole numbers of at least 2.")
    if keep not in ("clean", "largest", "all"):
        raise InputError(f"mesh: keep is {keep!r}, expected 'clean', 'largest' or 'all'.")
    lattice = _Lattice(field, resolution)
    blocks = [index for index in itertools.product(range(-(-resolution // block)), repeat=3) if _is_active(lattice, index, block)]
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    count = 0
    for done, index in enumerate(blocks, 1):
        low = np.array(index) * block
        values = lattice.block(low, np.minimum(low + block, resolution))
        lattice.agree(values, index)
        if values.min() < 0 < values.max():
            v, f, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
            vertices.append(v.astype(np.float64) + low)
            faces.append(f.astype(np.int64) + count)
            count += len(v)
        if progress is not None:
            progress(done, len(blocks))
    if not vertices:
        raise InputError("mesh: the field has no surface in the region of interest; fit longer, or check the region with `mmsynth info`.")
    v, f = _weld(np.concatenate(vertices), np.concatenate(faces), resolution)
    f = f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])]
    v = lattice.world(_refine(lattice, v))
    f = f[np.linalg.norm(v[f].mean(1) - lattice.centre, axis=1) <= lattice.radius]
    f = _keep(f, len(v), keep)
    if not len(f):
        raise InputError("mesh: the field has no surface in the region of interest; fit longer, or check the region with `mmsynth info`.")
    used, compact = np.unique(f, return_inverse=True)
    mesh = trimesh.Trimesh(v[used], compact.reshape(-1, 3), process=False)
    mesh.metadata["unit"] = field.unit
    return mesh


def _is_active(lattice: _Lattice, index: tuple[int, ...], block: int) -> bool:
    """Whether a block holds a coarse cell near the surface."""
    part = tuple(slice(i * block // _COARSE, -(-((i + 1) * block) // _COARSE)) for i in index)
    return bool(lattice.active[part].any())


def write_mesh(mesh: trimesh.Trimesh, path: Path, unit: str = "input unit") -> None:
    """Write PLY (binary), OBJ, STL (binary) or GLB, chosen by the suffix; PLY and OBJ say the unit in a comment.

    Raises:
        InputError: unknown suffix, or the disk refused.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: unknown mesh type '{path.suffix}', expected one of {' '.join(SUFFIXES)}.")
    note = f"mmsynth, unit: {unit}"
    if suffix == ".obj":
        exported = mesh.export(file_type="obj", header=note, digits=9)
    else:
        exported = mesh.export(file_type=suffix[1:])
    data = exported.encode() if isinstance(exported, str) else bytes(exported)
    if suffix == ".ply":
        first, second, rest = data.split(b"\n", 2)
        data = b"\n".join([first, second, f"comment {note}".encode("ascii", "replace"), rest])
    write_atomic(path, lambda temporary: temporary.write_bytes(data))
