"""Meshes as files, in the mesh's own frame and unit, which is nowhere changed.

* PLY (binary, little endian): per vertex position, normal, preview colour (red, green, blue: uint8), then every attribute as a float
  property of its own name; NaN = not seen. The header's comments say the unit, the frame, and of each property its channel and wavelength:
  ``comment property ms_3 channel 572, wavelength_nm 572, linear, 1 = full scale``. Positions are float, or double where that would move
  them by more than a thousandth of an edge. The confidence is called ``quality``, which MeshLab reads (it reads a float ``confidence``
  wrongly, and no names but its own).
* GLB: the same as attributes ``_MS_3`` beside POSITION, NORMAL and COLOR_0. glTF has no NaN: what is not seen is 0 there, and ``_VIEWS`` 0
  says so. glTF's own unit is the metre and its up is y; ours stay what they are and stand in the node's extras. Where surfaces mirror
  lamps, COLOR_0 is the base colour, and the material has the median roughness (glTF's is √α); of each vertex it is in ``_ROUGHNESS``.
* OBJ, STL: geometry only.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from mmsynth.errors import InputError
from mmsynth.files import write_atomic

SUFFIXES = (".ply", ".obj", ".stl", ".glb")
WITH_ATTRIBUTES = (".ply", ".glb")
FRAME = "the scene's own world frame"
_PLY_NAMES = {"confidence": "quality"}
_ROUNDING = 1e-3  # of an edge


def check_suffix(path: Path | str) -> str:
    """The suffix in lower case.

    Raises:
        InputError: it is none of a mesh.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: unknown mesh type '{Path(path).suffix}', expected one of {' '.join(SUFFIXES)}.")
    return suffix


def write_mesh(mesh: trimesh.Trimesh, path: Path | str, unit: str | None = None) -> None:
    """Write PLY, OBJ, STL or GLB, chosen by the suffix; whole or not at all.

    Args:
        unit: of the vertices; None: ``mesh.metadata["unit"]``.
    Raises:
        InputError: unknown suffix, or the disk refused.
    """
    path, suffix = Path(path), check_suffix(path)
    unit = str(mesh.metadata.get("unit", "input unit") if unit is None else unit)
    plain: Any
    note = f"mmsynth, unit: {unit}, frame: {FRAME}"
    if suffix == ".ply":
        data = _ply(mesh, ["mmsynth", f"unit {unit}", f"frame {FRAME}"])
    elif suffix == ".glb":
        data = _glb(mesh, unit)
    elif suffix == ".stl":
        plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        data = _ascii(note).ljust(80)[:80] + plain.export(file_type="stl")[80:]
    else:
        plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False, vertex_normals=mesh.vertex_normals)
        data = plain.export(file_type="obj", header=note, digits=9, include_normals=True).encode()
    write_atomic(path, lambda temporary: temporary.write_bytes(data))


def colours_of(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """(V, 4) uint8 preview colours, None where the mesh was given none."""
    visual: Any = mesh.visual
    return np.asarray(visual.vertex_colors) if visual.defined and visual.kind == "vertex" else None


def _ascii(text: str) -> bytes:
    return text.encode("ascii", "replace")


def _position_type(mesh: trimesh.Trimesh) -> str:
    edges = mesh.vertices[mesh.edges_unique]
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).mean() if len(edges) else 0.0
    return "f8" if np.spacing(np.float32(np.abs(mesh.vertices).max(initial=0.0))) > _ROUNDING * length else "f4"


def _ply(mesh: trimesh.Trimesh, comments: list[str]) -> bytes:
    names = {"f4": "float", "f8": "double", "u1": "uchar"}
    columns: dict[str, tuple[str, np.ndarray]] = {}
    place = _position_type(mesh)
    columns |= {c: (place, mesh.vertices[:, i]) for i, c in enumerate("xyz")}
    columns |= {f"n{c}": ("f4", mesh.vertex_normals[:, i]) for i, c in enumerate("xyz")}
    colours = colours_of(mesh)
    if colours is not None:
        columns |= {c: ("u1", colours[:, i]) for i, c in enumerate(("red", "green", "blue"))}
    columns |= {_PLY_NAMES.get(key, key): ("f4", np.asarray(value)) for key, value in mesh.vertex_attributes.items()}
    vertices = np.empty(len(mesh.vertices), [(key, "<" + kind) for key, (kind, _) in columns.items()])
    for key, (_, value) in columns.items():
        vertices[key] = value
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    comments = comments + [f"property {_PLY_NAMES.get(key, key)} {what}" for key, what in mesh.metadata.get("properties", {}).items()]
    header = [
        "ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments),
        f"element vertex {len(vertices)}", *(f"property {names[kind]} {key}" for key, (kind, _) in columns.items()),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    return b"".join([_ascii("\n".join(header) + "\n"), vertices.tobytes(), faces.tobytes()])


def _glb(mesh: trimesh.Trimesh, unit: str) -> bytes:
    attributes: dict[str, Any] = {
        key.upper(): np.where(np.isfinite(value), value, 0).astype(np.float32) for key, value in mesh.vertex_attributes.items()
    }
    extras: dict[str, Any] = {"unit": unit, "frame": FRAME, "properties": dict(mesh.metadata.get("properties", {}))}
    normals, colours = mesh.vertex_normals, colours_of(mesh)
    plain: Any = trimesh.Trimesh(mesh.vertices, mesh.faces, None, normals, None, colours, process=False, metadata=extras)
    plain.vertex_attributes.update(attributes)
    return bytes(plain.export(file_type="glb", include_normals=True, tree_postprocessor=functools.partial(_add_material, mesh)))


def _add_material(mesh: trimesh.Trimesh, tree: dict[str, Any]) -> None:
    """A dielectric of one roughness, in glTF's tree, where vertices have one each."""
    roughness = np.asarray(mesh.vertex_attributes.get("roughness", []), np.float32)
    if np.isfinite(roughness).any():
        factor = float(np.sqrt(np.nanmedian(roughness)))
        tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": factor}}]
        tree["meshes"][0]["primitives"][0]["material"] = 0
