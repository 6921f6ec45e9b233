"""Fewer triangles by collapsing edges at the least quadric error (Garland and Heckbert 1997).

By pymeshlab where it is installed (GPL-3, the extra ``meshlab``; this is the one module that imports it), which keeps the topology; else by
fast-simplification, many times faster with the same error, which may press two sheets of a surface together into edges of four faces. Its
result is checked, and it is asked again with other thresholds until it is as sound as what went in. It cuts corners of an open border.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import numpy as np

from mmsynth.errors import InputError
from mmsynth.operations.mesh.topology import topology, used_only

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) float64 and faces (F, 3) int64."""

_AGGRESSION = (3, 2, 4, 5, 1, 7)  # fast-simplification's; how fast its threshold grows. In the order of the errors that they leave
_LESS = (1.0, 1.02, 1.05, 1.1)  # faces to ask for instead, where nothing sound has so few
_SHORT = 1.05  # a result with more faces than that share stopped early
_BISECTIONS = 4


def decimate_to(mesh: Mesh, count: int) -> Mesh:
    """At most ``count`` faces, or as few as a sound mesh was found with.

    Raises:
        InputError: every result tears the mesh, or presses sheets of it together.
    """
    found = _simplified(mesh, count)
    if found is None:
        raise InputError(
            f"mesh: could not be decimated from {len(mesh[1]):,} to {count:,} faces without tearing it, "
            "expected more faces, or pymeshlab: pip install 'mmsynth[meshlab]'."
        )
    return found


def decimate_within(mesh: Mesh, error: Callable[[Mesh], float], largest: float) -> Mesh:
    """As few faces as halving and four bisections find with ``error`` of the result at most ``largest``.

    Args:
        error: of a mesh; it may move its vertices first. The mesh itself where already its error is larger.
    """
    good, bad = mesh, 0
    while not bad and len(good[1]) >= 8:
        count = len(good[1]) // 2
        tried = _simplified(good, count)
        if tried is None or len(tried[1]) > _SHORT * count or error(tried) > largest:
            bad = count
        else:
            good = tried
    for _ in range(_BISECTIONS if bad else 0):
        count = round((bad * len(good[1])) ** 0.5)
        tried = _simplified(good, count)
        if tried is None or error(tried) > largest:
            bad = count
        else:
            good = tried
    return good


def _simplified(mesh: Mesh, count: int) -> Mesh | None:
    """None where nothing sound was found."""
    vertices, faces = mesh
    if len(faces) <= count:
        return mesh
    found = (_pymeshlab if importlib.util.find_spec("pymeshlab") else _fast)(vertices, faces, count)
    return None if found is None else used_only(*found)


def _pymeshlab(vertices: np.ndarray, faces: np.ndarray, count: int) -> Mesh | None:
    import pymeshlab  # takes its time, and is under another licence

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces.astype(np.int32)))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=int(count), preservetopology=True, preservenormal=True, preserveboundary=True
    )
    found = meshes.current_mesh()
    return np.array(found.vertex_matrix(), dtype=np.float64), np.array(found.face_matrix(), dtype=np.int64)


def _fast(vertices: np.ndarray, faces: np.ndarray, count: int) -> Mesh | None:
    import fast_simplification

    open_before = topology(faces).boundary > 0
    # its quadrics are sums of squares of coordinates: far from the origin they would cancel
    middle = vertices.mean(0)
    scale = float(np.abs(vertices - middle).max())
    best: Mesh | None = None
    for less in _LESS:
        for aggression in _AGGRESSION:
            wanted = min(round(less * count), len(faces))
            v, f = fast_simplification.simplify(
                np.ascontiguousarray((vertices - middle) / scale), np.ascontiguousarray(faces.astype(np.int32)),
                target_count=wanted, agg=aggression,
            )  # fmt: skip
            found = topology(f)
            if found.closed or (open_before and found.crowded == found.twisted == 0):
                if best is None or len(f) < len(best[1]):
                    best = v * scale + middle, f.astype(np.int64)
                if len(f) <= _SHORT * wanted:
                    return best
    return best
