"""Sparse points of structure from motion, as PLY files hold them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class SparsePoints:
    """Points of the scene's surfaces: positions (N, 3) float64, finite, in the scene's frame; colours (N, 3) uint8, grey where unknown."""

    positions: np.ndarray
    colours: np.ndarray


def read_ply_points(path: Path) -> SparsePoints | None:
    """The finite points of a PLY file; None where there are none."""
    import trimesh  # takes its time

    try:
        cloud = trimesh.load(path)
        positions = np.asarray(getattr(cloud, "vertices", ()), dtype=np.float64)
        colours = np.asarray(getattr(getattr(cloud, "visual", None), "vertex_colors", getattr(cloud, "colors", ())))
    except Exception:  # a file of any kind may stand there, and each of trimesh's readers has its own exceptions
        return None
    if positions.ndim != 2 or positions.shape[1] != 3:
        return None
    coloured = colours.shape[:1] == positions.shape[:1] and colours.ndim == 2 and colours.shape[1] >= 3
    shades = colours[:, :3].astype(np.uint8) if coloured else np.full(positions.shape, 128, np.uint8)
    finite = np.isfinite(positions).all(1)
    return SparsePoints(positions[finite], shades[finite]) if finite.any() else None


def ply_of(points: SparsePoints) -> bytes:
    """A binary PLY file of points, in double precision: worlds far from their origin keep their digits."""
    vertices = np.empty(len(points.positions), [("at", "<f8", 3), ("colour", "u1", 3)])
    vertices["at"], vertices["colour"] = points.positions, points.colours
    properties = [*(f"property double {axis}" for axis in "xyz"), *(f"property uchar {name}" for name in ("red", "green", "blue"))]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties, "end_header"]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes()
