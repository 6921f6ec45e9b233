"""Topology of a triangle mesh: edges, components, whether it is closed. From vertex indices alone, without distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True)
class Topology:
    """Counts of a mesh.

    Attributes:
        edges: in all. boundary: those of one face. crowded: those of more than two. twisted: those whose faces do not turn opposite ways.
    """

    vertices: int
    faces: int
    edges: int
    boundary: int
    crowded: int
    twisted: int

    @property
    def closed(self) -> bool:
        """Whether the mesh is watertight: every edge has two faces, that turn opposite ways."""
        return self.faces > 0 and self.boundary == self.crowded == self.twisted == 0

    @property
    def euler_number(self) -> int:
        """V - E + F: of one closed surface 2 - 2 genus."""
        return self.vertices - self.edges + self.faces


def topology(faces: np.ndarray) -> Topology:
    """Count the edges of faces (F, 3); vertices that no face has do not count."""
    faces = faces.astype(np.int64)
    count = int(faces.max(initial=-1)) + 1
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    forward = start < end
    edge = np.where(forward, start * count + end, end * count + start)
    # an edge's faces lie side by side, and the sign of each says which way it runs along the edge
    order = np.argsort(edge, kind="stable")
    edge, turn = edge[order], np.where(forward[order], 1, -1)
    first = np.flatnonzero(np.concatenate([[True], edge[1:] != edge[:-1]])) if len(edge) else np.empty(0, np.int64)
    many = np.diff(np.append(first, len(edge)))
    balance = np.add.reduceat(turn, first) if len(first) else np.empty(0, np.int64)
    used = int(np.count_nonzero(np.bincount(start, minlength=1)))
    return Topology(used, len(faces), len(first), int((many == 1).sum()), int((many > 2).sum()), int(((many == 2) & (balance != 0)).sum()))


def components(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """(F,) number of each face's component, from 0; faces that share a vertex belong together."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(vertex_count, vertex_count))
    _, number = np.unique(connected_components(graph, directed=False)[1][faces[:, 0]], return_inverse=True)
    return number


def used_only(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without the vertices that no face has."""
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return vertices[used], (np.cumsum(used) - 1)[faces]
