"""The surface of a field as a triangle mesh, with what every modality sees on it.

From left to right: the zero level (``marching``), its cut at the region's border, the components that are kept, fewer faces
(``decimation``), vertices moved onto the zero by Newton steps, normals from the distance's gradient, and last, at the final vertices, the
attributes (``attributes``): a decimation that carried them would leave them behind its vertices. ``files`` writes the result,
``quality`` says what it is.

The mesh is in the scene's world frame and unit. What lies beyond the region of interest was learned with less care, or not at all: a
surface that leaves the region's ball ends there, open, or closed by the ball: the surface of field ∩ ball, max(f, |x - c| - R).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np
import trimesh

from mmsynth.errors import InputError
from mmsynth.operations.mesh.attributes import add_attributes, depth_maps, training_views, views_that_see
from mmsynth.operations.mesh.decimation import Mesh, decimate_to, decimate_within
from mmsynth.operations.mesh.files import WITH_ATTRIBUTES, check_suffix, write_mesh
from mmsynth.operations.mesh.marching import Distance, checked, gradient, march
from mmsynth.operations.mesh.quality import compare_meshes, describe_mesh, load_reference
from mmsynth.operations.mesh.topology import components, used_only
from mmsynth.operations.output.progress import Progress, parts

if TYPE_CHECKING:
    from mmsynth.field.field import Field
    from mmsynth.scene.scene import Scene

_FLOATER = 1e-3  # of the whole area
_SETTLED = 1e-4  # cells from the zero
_WITHIN = 0.999
_PROBED = 512  # vertices of a component that are looked at

Kept = Literal["clean", "all", "largest"]


@dataclass(frozen=True)
class MeshOptions:
    """How a surface is meshed.

    Attributes:
        resolution: cells across the region; the cell is the smallest thing that can show.
        block: cells along a block. Memory grows with block³ and with the surface, not with resolution³.
        keep: components: "clean" drops those below 1e-3 of the area, "all" keeps everything, "largest" one, 5 the five largest.
        closed: close the surface where the region's border cuts it.
        attributes: with a scene, vertices have attributes of every modality.
        min_views: keep components only of which at least so many training views see something; needs a scene.
        faces: decimate to so many. max_error: decimate as far as 99.9 % of the surface stays that near to the zero (scene unit).
    Raises:
        InputError: a value out of its range, or both of faces and max_error.
    """

    resolution: int = 256
    block: int = 64
    keep: Kept | int = "clean"
    closed: bool = False
    attributes: bool = True
    min_views: int = 0
    faces: int | None = None
    max_error: float | None = None

    def __post_init__(self) -> None:
        if self.resolution < 2 or self.block < 2:
            raise InputError(f"mesh: resolution {self.resolution} and block {self.block}, expected whole numbers of at least 2.")
        if not (self.keep >= 1 if isinstance(self.keep, int) else self.keep in get_args(Kept)):
            raise InputError(f"mesh: keep is '{self.keep}', expected 'clean', 'all', 'largest' or a number of components.")
        if self.faces is not None and self.max_error is not None:
            raise InputError("mesh: give one of a number of faces and a largest error.")
        if self.faces is not None and self.faces < 4:
            raise InputError(f"mesh: {self.faces} faces, expected at least 4.")
        if self.max_error is not None and not self.max_error > 0:
            raise InputError(f"mesh: a largest error of {self.max_error}, expected a length above 0.")


DEFAULT = MeshOptions()


def keep_of(text: str) -> Kept | int:
    """``MeshOptions.keep`` from a word or a number in text; what is neither is refused by ``MeshOptions``."""
    return int(text) if text.isdecimal() else cast(Kept, text)


def extract_mesh(
    field: Field, options: MeshOptions = DEFAULT, *, scene: Scene | None = None, progress: Progress | None = None
) -> trimesh.Trimesh:
    """The field's zero level inside its region of interest.

    Args:
        scene: gives the training views, for attributes and ``min_views``. progress: called with (parts done, parts in all).
    Returns:
        mesh in the scene's world frame and unit, faces counter-clockwise seen from outside, normals from the distance's gradient,
        ``vertex_attributes`` by property (see ``attributes``), ``metadata["unit"]`` and ``metadata["properties"]``.
    Raises:
        InputError: more views asked for than there are, no surface in the region, or a field whose distance is not a number.
    """
    _check_views(options.min_views, scene)
    region, cell = field.region, 2.0 * field.region.radius / options.resolution
    sdf = surface_distance(field, options.closed)
    baked = options.attributes and scene is not None
    shares = parts(progress, (0.2, 0.8) if baked else (1.0,))
    v, f = march(sdf, region, options.resolution, options.block, next(shares))
    if not options.closed:
        f = f[np.linalg.norm(v[f].mean(1) - region.centre, axis=1) <= region.radius]
    v, f = used_only(v, f)
    f = _keep(v, f, options.keep)
    if options.min_views and scene is not None and len(f):
        f = _seen(field, scene, v, f, sdf, cell, options.min_views)
    if not len(f):
        seen = f" that {options.min_views} training views see" if options.min_views else ""
        raise InputError(f"mesh: the field has no surface in the region of interest{seen}; fit longer, or check with `mmsynth info`.")
    v, f = used_only(v, f)
    if options.faces is not None:
        v, f = decimate_to((v, f), options.faces)
    elif options.max_error is not None:
        v, f = decimate_within((v, f), lambda fewer: _residual(sdf, fewer, cell), options.max_error)
    v = settle(sdf, v, cell)
    mesh = trimesh.Trimesh(v, f, process=False, vertex_normals=normals(sdf, v, cell))
    mesh.metadata.update(unit=field.unit, properties={})
    if baked and scene is not None:
        add_attributes(mesh, field, scene, cell, next(shares))
    return mesh


def mesh_to_file(
    field: Field,
    out: Path,
    options: MeshOptions = DEFAULT,
    *,
    scene: Scene | None = None,
    against: Path | None = None,
    distances: Sequence[float] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """``extract_mesh``, written and described.

    Args:
        out: PLY or GLB; OBJ and STL have no attributes. against: a mesh to compare with, in the same frame and unit, where the training
            views see it (all of it without a scene). distances: of the F-score (scene unit).
    Returns:
        see ``quality``: ``out, resolution, cell, vertices, ..., residual, against, seconds``, ready for JSON.
    Raises:
        InputError: as ``extract_mesh`` and ``write_mesh``; the other mesh cannot be read or compared. Nothing is written then.
    """
    if check_suffix(out) not in WITH_ATTRIBUTES:
        options = replace(options, attributes=False)
    reference = None if against is None else load_reference(against)
    began = time.perf_counter()
    mesh = extract_mesh(field, options, scene=scene, progress=progress)
    extracted = time.perf_counter()
    cell = 2.0 * field.region.radius / options.resolution
    report: dict[str, Any] = {"out": str(out), "resolution": options.resolution, "cell": cell}
    report |= describe_mesh(mesh, surface_distance(field, options.closed), cell)
    if reference is not None:
        views = [] if scene is None else training_views(field, scene)
        scores = compare_meshes(mesh, reference, region=field.region, views=views, distances=distances)
        report["against"] = {"mesh": str(against), **scores}
    reported = time.perf_counter()
    write_mesh(mesh, out)
    report["seconds"] = {"extract": extracted - began, "report": reported - extracted, "write": time.perf_counter() - reported}
    return report


def _check_views(min_views: int, scene: Scene | None) -> None:
    if min_views and scene is None:
        raise InputError("mesh: min_views needs a scene, whose training views tell what is seen.")
    if min_views and scene is not None and min_views > len(scene.split.train):
        raise InputError(f"mesh: min_views is {min_views}, expected at most the {len(scene.split.train)} training views of the scene.")


def surface_distance(field: Field, closed: bool = False) -> Distance:
    """The function whose zero is meshed: the field's distance, and with ``closed`` cut by the region's ball."""
    if not closed:
        return field.sdf
    centre, radius = np.array(field.region.centre), field.region.radius
    return lambda points: np.maximum(field.sdf(points), np.linalg.norm(points - centre, axis=1) - radius)


def _keep(vertices: np.ndarray, faces: np.ndarray, keep: Kept | int) -> np.ndarray:
    """Faces of the components that are large enough."""
    if keep == "all" or not len(faces):
        return faces
    component = components(faces, len(vertices))
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.bincount(component, 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))
    if keep == "clean":
        return faces[area[component] >= _FLOATER * area.sum()]
    most = np.argsort(-area, kind="stable")[: 1 if keep == "largest" else keep]
    return faces[np.isin(component, most)]


def _seen(field: Field, scene: Scene, vertices: np.ndarray, faces: np.ndarray, sdf: Distance, cell: float, min_views: int) -> np.ndarray:
    """Faces of the components of which enough training views see something."""
    component = components(faces, len(vertices))
    of_vertex = np.zeros(len(vertices), np.int64)
    of_vertex[faces] = component[:, None]
    # some vertices of each, evenly spread over its own
    order = np.argsort(of_vertex, kind="stable")
    count = np.bincount(of_vertex)
    place = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    stride = -(-np.repeat(count, count) // _PROBED)
    probes = order[place % stride == 0]
    seen = views_that_see(depth_maps(field, scene), vertices[probes], normals(sdf, vertices[probes], cell))
    by_view = np.zeros((len(count), seen.shape[0]), bool)
    np.logical_or.at(by_view, of_vertex[probes], seen.T)
    return faces[(by_view.sum(1) >= min_views)[component]]


def _residual(sdf: Distance, mesh: Mesh, cell: float) -> float:
    """|f| at the middles of faces and of their edges, when the vertices are on the zero: the largest, but for a thousandth of them.

    At a crease already the finest mesh is half a cell off; that shall not keep the rest from being decimated.
    """
    corners = settle(sdf, mesh[0], cell)[mesh[1]]
    places = np.concatenate([corners.mean(1), *(0.5 * (corners[:, i] + corners[:, i - 1]) for i in range(3))])
    return float(np.quantile(np.abs(checked(sdf, places)), _WITHIN))


def settle(sdf: Distance, vertices: np.ndarray, cell: float, rounds: int = 4) -> np.ndarray:
    """Move vertices onto the zero by Newton steps -f ∇f / |∇f|² of at most a cell; a step that does not lower |f| is not taken.

    Args:
        vertices: (V, 3) world. cell: scene unit.
    Returns:
        (V, 3) float64. Those that are within 1e-4 cells already stay.
    """
    out = vertices.copy()
    rows = np.arange(len(out))
    value = checked(sdf, out)
    for _ in range(rounds):
        off = np.abs(value) > _SETTLED * cell
        rows, value = rows[off], value[off]
        if not len(rows):
            break
        slope = gradient(sdf, out[rows], cell)
        square = (slope * slope).sum(1)
        flat = square == 0.0
        step = -(value / np.where(flat, 1.0, square))[:, None] * slope
        length = np.linalg.norm(step, axis=1)
        step *= np.where(length > cell, cell / np.where(length > 0, length, 1.0), 1.0)[:, None]
        found = checked(sdf, out[rows] + step)
        better = np.abs(found) < np.abs(value)
        out[rows[better]] += step[better]
        rows, value = rows[better], found[better]
    return out


def normals(sdf: Distance, vertices: np.ndarray, cell: float) -> np.ndarray:
    """(V, 3) unit ∇f, outward, by central differences of a cell; NaN where the field has no slope."""
    slope = gradient(sdf, vertices, cell)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    return np.divide(slope, length, out=np.full_like(slope, np.nan), where=length > 0)
