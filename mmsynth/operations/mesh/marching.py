"""A zero level as triangles: marching cubes over the blocks of one global lattice, where the distance says a surface may be.

Symbols: ``n`` cells across the region, ``h`` cell size (scene unit), R the region's radius. Lattice point (i, j, k), whole numbers in
-1..n+1, lies at ``centre - R + h (i, j, k)``: the cube around the region's ball and a cell more on each side. Everything that decides the
topology hangs on the whole numbers:

* a lattice point shared by blocks has one value (the first one computed is kept: a network's last bit may depend on its batch),
* vertices are welded by the lattice edge they lie on, never by distance,

so blocks meet without seams.

Where to look: let L bound how fast the values change. Corners and centre of a cell of size a are a body-centred lattice, and no point of
the cell is farther than a √5 / 4 from all of them. So if |f| > L a √5 / 4 at all nine and their signs agree, the cell holds no surface.
Blocks, then parts of 16 and of 4 cells, are ruled out by that; only what is left is evaluated at every lattice point. L is measured (a
learned distance has no slope of exactly 1): see ``steepest``.

Marching cubes: Lewiner et al. 2003 (scikit-image), topologically correct per cell.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
from skimage.measure import marching_cubes

from mmsynth.errors import InputError
from mmsynth.operations.output.progress import Progress
from mmsynth.scene.scene import Region

Distance = Callable[[np.ndarray], np.ndarray]
"""World points (N, 3) → (N,) signed distance, positive outside."""

_PARTS = (16, 4)  # cells along the parts of a block that are ruled out
_COVER = math.sqrt(5.0) / 4.0
_SLACK = 1.25  # of the steepest slope that was met: others may be steeper
_PROBES = 1 << 16
_SNAP = 1e-4  # no vertex is nearer than this (in cells) to a lattice point: edges that meet there keep vertices of their own
_BATCH = 1 << 19  # points per call: what a call needs beside them is bounded
_CORNERS = tuple(itertools.product((0, 1), repeat=3))


def steepest(sdf: Distance, region: Region, step: float) -> float:
    """A bound of |∇f| in the region: the largest by central differences of ``step`` at 65,536 points of the ball, and a quarter more.

    Raises:
        InputError: a value is not a number.
    """
    rng = np.random.default_rng(0)
    points = rng.normal(size=(_PROBES, 3))
    points *= (region.radius * rng.random(_PROBES) ** (1 / 3) / np.linalg.norm(points, axis=1))[:, None]
    slopes = np.linalg.norm(gradient(sdf, points + np.array(region.centre), step), axis=1)
    return _SLACK * float(slopes.max())


def gradient(sdf: Distance, points: np.ndarray, step: float) -> np.ndarray:
    """∇f at world points (N, 3) by central differences of ``step`` (scene unit): (N, 3) float64."""
    out = np.empty((len(points), 3))
    for axis, shift in enumerate(0.5 * step * np.eye(3)):
        out[:, axis] = (checked(sdf, points + shift) - checked(sdf, points - shift)) / step
    return out


def checked(sdf: Distance, points: np.ndarray) -> np.ndarray:
    """Values at world points (N, 3): (N,) float64.

    Raises:
        InputError: a value is not a number.
    """
    out = np.empty(len(points))
    for start in range(0, len(points), _BATCH):
        out[start : start + _BATCH] = sdf(points[start : start + _BATCH])
    bad = np.flatnonzero(~np.isfinite(out))
    if bad.size:
        where = ", ".join(f"{x:.6g}" for x in points[bad[0]])
        raise InputError(f"mesh: the field's distance at ({where}) is {out[bad[0]]}, expected a number; its fit went wrong.")
    return out


class _Lattice:
    """The global lattice, and what blocks know of each other."""

    def __init__(self, sdf: Distance, region: Region, n: int) -> None:
        self.field_sdf, self.n = sdf, n
        self.centre, self.radius = np.asarray(region.centre, dtype=np.float64), float(region.radius)
        self.h = 2.0 * self.radius / n
        self.bound = steepest(sdf, region, self.h)
        # a field without any slope has no surface; its values stay what they are
        self.tiny = np.float32(_SNAP * self.h * self.bound) if self.bound > 0 else np.finfo(np.float32).tiny
        self.shared: dict[tuple[int, ...], np.ndarray] = {}
        self.slab = 0

    def world(self, lattice: np.ndarray) -> np.ndarray:
        """Lattice coordinates (..., 3) → world."""
        return self.centre - self.radius + lattice * self.h

    def sdf(self, lattice: np.ndarray) -> np.ndarray:
        """Lattice coordinates (N, 3) → (N,) float32 values, never exactly 0."""
        value = checked(self.field_sdf, self.world(lattice)).astype(np.float32)
        return np.where(np.abs(value) < self.tiny, np.where(value < 0, -self.tiny, self.tiny), value)

    def rule_out(self, low: np.ndarray, size: int, candidates: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which cells may hold a surface inside the ball.

        Args:
            low: (3,) where the first cell begins. size: of the cells. candidates: (a, b, c) bool. known: (a, b, c) float32, the value
                near each cell that was ruled out already.
        Returns:
            the candidates that are left, and ``known`` with their values at the centres.
        """
        left, known = candidates.copy(), known.copy()
        at = np.argwhere(candidates)
        middle = (at + 0.5) * size + low
        # a cell that only touches the ball still counts
        inside = np.linalg.norm(self.world(middle) - self.centre, axis=1) <= self.radius + 0.5 * math.sqrt(3.0) * size * self.h
        left[tuple(at[~inside].T)] = False
        known[tuple(at[~inside].T)] = self.radius
        at, middle = at[inside], middle[inside]
        if not len(at):
            return left, known
        value = self.sdf(middle)
        known[tuple(at.T)] = value
        corners = np.zeros(tuple(s + 1 for s in candidates.shape), bool)
        for shift in _CORNERS:
            corners[tuple((at + shift).T)] = True
        values = np.empty(corners.shape, np.float32)
        values[corners] = self.sdf(np.argwhere(corners) * size + low)
        samples = np.stack([value, *(values[tuple((at + shift).T)] for shift in _CORNERS)])
        near = np.abs(samples).min(0) <= self.bound * _COVER * size * self.h
        near |= (samples.min(0) < 0) & (samples.max(0) > 0)
        left[tuple(at[~near].T)] = False
        return left, known

    def block(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Values at the lattice points ``low..high`` (both included), float32; far from the surface, of the right sign only."""
        left, known, size = np.ones((1, 1, 1), bool), np.zeros((1, 1, 1), np.float32), int((high - low).max())
        for part in _PARTS:
            if part < size:
                left, known = (_split(x, size, part, high - low) for x in (left, known))
                left, known, size = *self.rule_out(low, part, left, known), part
        values, wanted = known, left
        for axis in range(3):
            points = np.arange(high[axis] - low[axis] + 1)
            after = np.minimum(points // size, values.shape[axis] - 1)
            before = np.maximum(points - 1, 0) // size
            values = values.take(after, axis)
            wanted = wanted.take(before, axis) | wanted.take(after, axis)
        values[wanted] = self.sdf(np.argwhere(wanted) + low)
        return values

    def agree(self, values: np.ndarray, index: tuple[int, ...]) -> None:
        """Give lattice points on the hull of block ``index`` the values that earlier blocks have for them."""
        if index[0] > self.slab:
            # blocks come slab by slab: of those before, only the plane between is still asked for
            self.shared = {key: known for key, known in self.shared.items() if key[0] >= 2 * index[0]}
            self.slab = index[0]
        sides = (slice(0, 1), slice(1, -1), slice(-1, None))
        for place in itertools.product(range(3), repeat=3):
            if place == (1, 1, 1):
                continue
            part = tuple(sides[p] for p in place)
            key = tuple(2 * i + p for i, p in zip(index, place, strict=True))  # the same face, edge or corner in any block
            known = self.shared.setdefault(key, values[part].copy())
            values[part] = known


def _split(cells: np.ndarray, size: int, part: int, extent: np.ndarray) -> np.ndarray:
    """Values of cells of ``size`` as those of cells of ``part``, as many as ``extent`` (3,) takes."""
    for axis in range(3):
        cells = cells.take(np.arange(-(-int(extent[axis]) // part)) * part // size, axis)
    return cells


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
    key = 2 * (floor + 1) + (vertices > floor)
    size = 2 * (n + 4)
    flat = (key[:, 0] * size + key[:, 1]) * size + key[:, 2]
    _, first, inverse = np.unique(flat, return_index=True, return_inverse=True)
    return vertices[first], inverse.reshape(-1)[faces]


def march(sdf: Distance, region: Region, n: int, block: int, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The zero level in the region's ball and, where it leaves the ball, up to a cell beyond.

    Args:
        n: cells across the region. block: cells along a block; memory grows with block³ and with the surface, not with n³.
        progress: called with (blocks done, blocks in all).
    Returns:
        vertices (V, 3) float64, world, on lattice edges, each within 1e-3 cells of the zero along its edge; faces (F, 3) int64,
        counter-clockwise seen from outside. Both may be empty.
    Raises:
        InputError: a value is not a number.
    """
    lattice = _Lattice(sdf, region, n)
    count = -(-(n + 2) // block)
    start = np.full(3, -1)
    everything = np.ones((count,) * 3, bool)
    active = np.argwhere(lattice.rule_out(start, block, everything, np.zeros(everything.shape, np.float32))[0])
    vertices: list[np.ndarray] = [np.empty((0, 3))]
    faces: list[np.ndarray] = [np.empty((0, 3), np.int64)]
    total = 0
    for done, index in enumerate(active, 1):
        low = start + index * block
        values = lattice.block(low, np.minimum(low + block, n + 1))
        lattice.agree(values, tuple(int(i) for i in index))
        if values.min() < 0 < values.max():
            v, f, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
            vertices.append(_refine(lattice, v.astype(np.float64) + low))
            faces.append(f.astype(np.int64) + total)
            total += len(v)
        if progress is not None:
            progress(done, len(active))
    v, f = _weld(np.concatenate(vertices), np.concatenate(faces), n)
    f = f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])]
    return lattice.world(v), f
