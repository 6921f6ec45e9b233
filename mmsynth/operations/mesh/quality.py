"""A mesh in figures, and its distance to another mesh.

``describe_mesh``: counts, components, watertight, Euler number, boundary edges, area, volume (of a watertight mesh only), bounds; with the
field also the residual |f| at the vertices and the middles of faces, in the scene's unit.

``compare_meshes``: a mesh against a reference in the same frame and unit, by points drawn evenly over both areas:

* ``accuracy``: mean distance of our points to the reference; ``completeness``: of the reference's points to ours; ``chamfer``: their mean.
  Distances are to triangles of the whole other mesh, not to points: to those whose middle, or a point on them, is among the nearest
  eight.
* ``f_score`` at each distance d: harmonic mean of the shares of points, of ours and of the reference's, that are nearer than d.
* ``reference_in_region``: share of the reference's area; where it is small, is it in the same unit?
* ``normal_consistency``: mean cosine between normals at nearest points, both ways, averaged; -1 for a mesh that is inside out.

With views only what can be known is scored. The points of both meshes are culled:

* to the region's ball;
* to what the views see: a point must face a view and be the first thing along its ray, by a depth map of the mesh's own points;
* of ours, to where the reference has something to say: half or more of the views that see the point must see the reference, or nothing
  but it, at its pixel. (A reference of the objects alone says nothing about the table that they stand on.)
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from mmsynth.errors import InputError
from mmsynth.operations.mesh.attributes import View, coarse
from mmsynth.operations.mesh.marching import Distance, checked
from mmsynth.operations.mesh.topology import components, topology
from mmsynth.operations.views.visibility import inside
from mmsynth.scene.scene import PosedCamera, Region
from mmsynth.sensors.camera import project

SAMPLES = 200_000
_SPLAT = 200_000  # points that make the depth maps: several for each of their coarse pixels
_NEAREST = 8
_SHARES = (0.005, 0.01, 0.02)  # of the region's radius: the distances of the F-score where none are given


def describe_mesh(mesh: trimesh.Trimesh, sdf: Distance | None = None, cell: float | None = None) -> dict[str, Any]:
    """Counts, topology and size, ready for JSON; residuals with ``sdf``, also in cells with ``cell`` (scene unit)."""
    faces = np.asarray(mesh.faces)
    found = topology(faces)
    out: dict[str, Any] = {
        "vertices": len(mesh.vertices),
        "faces": found.faces,
        "components": int(components(faces, len(mesh.vertices)).max()) + 1,
        "watertight": found.closed,
        "boundary_edges": found.boundary,
        "euler_number": found.euler_number,
        "area": float(mesh.area),
        "volume": float(mesh.volume) if found.closed else None,
        "bounds": mesh.bounds.tolist(),
        "unit": str(mesh.metadata.get("unit", "input unit")),
    }
    if sdf is not None:
        at_vertices, at_faces = (np.abs(checked(sdf, x)) for x in (np.asarray(mesh.vertices), mesh.triangles_center))
        out["residual"] = {
            "rms": float(np.sqrt(np.mean(at_vertices**2))),
            "max": float(at_vertices.max()),
            "faces_rms": float(np.sqrt(np.mean(at_faces**2))),
            "faces_max": float(at_faces.max()),
        }
        if cell is not None:
            out["residual"] |= {"cell": cell, "rms_cells": out["residual"]["rms"] / cell, "max_cells": out["residual"]["max"] / cell}
    return out


def load_reference(path: Path) -> trimesh.Trimesh:
    """A triangle mesh from a file, nothing merged.

    Raises:
        InputError: it is missing, unreadable, or has no triangles.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file, expected a mesh to compare with.")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # every format has its own exceptions for a damaged file
        raise InputError(f"{path}: could not be read as a mesh ({error}).") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: holds no triangles, expected a mesh to compare with.")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path}: has a vertex that is not a number.")
    return mesh


class _Samples:
    """Points drawn evenly over a mesh's area: points (N, 3), normals (N, 3) of their triangles, ``face`` (N,)."""

    def __init__(self, mesh: trimesh.Trimesh, count: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        triangles = mesh.triangles
        cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        double = np.linalg.norm(cross, axis=1)
        # one random shift of an even comb over the area: far more even than independent draws
        place = (np.arange(count) + rng.random()) * (double.sum() / count)
        self.face = np.minimum(np.searchsorted(np.cumsum(double), place), len(double) - 1)
        a, b = rng.random((2, count))
        root = np.sqrt(a)
        weights = np.stack([1 - root, root * (1 - b), root * b], 1)
        self.points = np.einsum("nk,nkd->nd", weights, triangles[self.face])
        self.normals = cross[self.face] / double[self.face, None]
        self.mesh = mesh

    def keep(self, rows: np.ndarray) -> None:
        self.points, self.normals, self.face = self.points[rows], self.normals[rows], self.face[rows]


def compare_meshes(
    mesh: trimesh.Trimesh,
    reference: trimesh.Trimesh,
    *,
    region: Region | None = None,
    views: Sequence[PosedCamera] = (),
    distances: Sequence[float] | None = None,
    samples: int = SAMPLES,
) -> dict[str, Any]:
    """Score a mesh against a reference (definitions: module docstring), ready for JSON; the same unit throughout.

    Args:
        region: only what is in its ball counts. views: only what they see counts.
        distances: of the F-score; None: 0.5, 1 and 2 % of the radius of the region, or of half the reference's diagonal.
        samples: points on each mesh, before culling.
    Raises:
        InputError: nothing is left to compare.
    """
    radius = region.radius if region is not None else 0.5 * float(np.linalg.norm(np.ptp(reference.bounds, axis=0)))
    at = [share * radius for share in _SHARES] if distances is None else list(distances)
    ours, true = _Samples(mesh, samples, 0), _Samples(reference, samples, 1)
    to_ours, to_true = _Triangles(ours), _Triangles(true)
    share = 1.0
    if region is not None:
        share = float((np.linalg.norm(true.points - np.array(region.centre), axis=1) <= region.radius).mean())
        for drawn in (ours, true):
            drawn.keep(np.linalg.norm(drawn.points - np.array(region.centre), axis=1) <= region.radius)
    if views:
        coarse_views = [coarse(view) for view in views]
        of_ours, of_true = (_depth_maps(m, coarse_views) for m in (mesh, reference))
        known = _known(of_ours, of_true, ours)
        seen = np.logical_or.reduce([view.sees(true.points, true.normals) > 0 for view in of_true])
        ours.keep(known)
        true.keep(seen)
    for drawn, name in ((ours, "mesh"), (true, "reference")):
        if not len(drawn.points):
            culled = " that the views see" if views else ""
            raise InputError(f"mesh: nothing of the {name} in the region{culled}; is the reference in the mesh's frame and unit?")
    there, cosine_there = to_true.nearest(ours)
    back, cosine_back = to_ours.nearest(true)
    scores = {}
    for d in at:
        precision, recall = float((there <= d).mean()), float((back <= d).mean())
        scores[f"{d:.6g}"] = 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
    return {
        "accuracy": float(there.mean()),
        "completeness": float(back.mean()),
        "chamfer": 0.5 * float(there.mean() + back.mean()),
        "accuracy_median": float(np.median(there)),
        "completeness_median": float(np.median(back)),
        "f_score": scores,
        "normal_consistency": 0.5 * float(cosine_there.mean() + cosine_back.mean()),
        "points": [len(there), len(back)],
        "reference_in_region": share,
        "views": len(views),
    }


class _Triangles:
    """Finds the nearest point of a mesh: small triangles by their middles, large ones by the samples on them."""

    def __init__(self, samples: _Samples) -> None:
        self.triangles = samples.mesh.triangles
        self.face = np.concatenate([samples.face, np.arange(len(self.triangles))])
        self.tree = cKDTree(np.concatenate([samples.points, self.triangles.mean(1)]))
        cross = np.cross(self.triangles[:, 1] - self.triangles[:, 0], self.triangles[:, 2] - self.triangles[:, 0])
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        # a triangle without an area has no normal, and agrees with nobody
        self.normals = np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)

    def nearest(self, of: _Samples) -> tuple[np.ndarray, np.ndarray]:
        """Distance (N,) of points, and the cosine between the normals there."""
        _, found = self.tree.query(of.points, k=_NEAREST)
        best, cosine = np.full(len(of.points), np.inf), np.zeros(len(of.points))
        for k in range(_NEAREST):
            face = self.face[found[:, k]]
            closest = trimesh.triangles.closest_point(self.triangles[face], of.points)
            distance = np.linalg.norm(closest - of.points, axis=1)
            nearer = distance < best
            best[nearer] = distance[nearer]
            cosine[nearer] = np.einsum("ni,ni->n", of.normals[nearer], self.normals[face[nearer]])
        return best, cosine


def _depth_maps(mesh: trimesh.Trimesh, views: Sequence[PosedCamera]) -> list[View]:
    """Of the points of a mesh, the nearest in each pixel."""
    points = _Samples(mesh, _SPLAT, 2).points
    out = []
    for view in views:
        camera, pose = view.camera, view.camera_to_world
        away = points - pose[:3, 3]
        pixels = project(away @ pose[:3, :3], camera)
        within = inside(pixels, camera)
        column, row = np.rint(pixels[within]).astype(np.int64).T
        depth = np.full((camera.height, camera.width), np.inf)
        np.minimum.at(depth, (row, column), np.linalg.norm(away[within], axis=1))
        out.append(View(view, np.where(np.isfinite(depth), depth, np.nan)))
    return out


def _known(ours: Sequence[View], true: Sequence[View], points: _Samples) -> np.ndarray:
    """(N,) bool: points that views see, at pixels where, for half of these views or more, there is something of the reference."""
    seen, with_reference = np.zeros(len(points.points)), np.zeros(len(points.points))
    for view, other in zip(ours, true, strict=True):
        rows = np.flatnonzero(view.sees(points.points, points.normals) > 0)
        camera, pose = view.posed.camera, view.posed.camera_to_world
        pixels = np.rint(project((points.points[rows] - pose[:3, 3]) @ pose[:3, :3], camera)).astype(np.int64)
        seen[rows] += 1
        with_reference[rows] += np.isfinite(other.depth_ray[pixels[:, 1], pixels[:, 0]])
    return (seen > 0) & (2 * with_reference >= seen)
