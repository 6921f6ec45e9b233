"""Meshes as files: what other readers find in them, in which unit, and that nothing is half-written."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from analytic import MONO, MS, POL, RGB, AnalyticField, scene_of, sphere

from mmsynth.errors import InputError
from mmsynth.operations.mesh.extract import MeshOptions, extract_mesh, write_mesh
from mmsynth.scene.scene import Region

TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}


@pytest.fixture(scope="module")
def mesh(tmp_path_factory: pytest.TempPathFactory) -> trimesh.Trimesh:
    field = AnalyticField(sphere(0.6), (RGB, MS, POL, MONO))
    return extract_mesh(field, MeshOptions(24), scene=scene_of(field, tmp_path_factory.mktemp("scene"), truth=False))  # type: ignore[arg-type]


def read_ply(path: Path) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Comments, vertices and faces, by the letter of the format."""
    data = path.read_bytes()
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    (at,) = (i for i, line in enumerate(lines) if line.startswith("element face"))
    properties = [line.split()[1:] for line in lines[:at] if line.startswith("property")]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    kind = np.dtype([(name, TYPES[t]) for t, name in properties])
    vertices = np.frombuffer(body, kind, count)
    faces = np.frombuffer(body[count * kind.itemsize :], [("n", "u1"), ("v", "<i4", 3)])
    assert lines[at + 1 :] == ["property list uchar int vertex_indices"] and len(faces) == int(lines[at].split()[2])
    return [line[8:] for line in lines if line.startswith("comment ")], vertices, faces["v"]


def test_ply_by_the_letter(mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    write_mesh(mesh, tmp_path / "mesh.ply")
    comments, vertices, faces = read_ply(tmp_path / "mesh.ply")
    assert "unit m" in comments and any(line.startswith("frame ") for line in comments)
    assert "property ms_3 channel 572, wavelength_nm 572, linear, 1 = full scale" in comments
    assert np.array_equal(faces, mesh.faces)
    assert np.array_equal(np.stack([vertices[c] for c in "xyz"], -1), mesh.vertices.astype(np.float32))
    assert np.array_equal(np.stack([vertices[f"n{c}"] for c in "xyz"], -1), mesh.vertex_normals.astype(np.float32))
    visual: Any = mesh.visual
    assert np.array_equal(np.stack([vertices[c] for c in ("red", "green", "blue")], -1), visual.vertex_colors[:, :3])
    for name, value in mesh.vertex_attributes.items():
        stored = vertices["quality" if name == "confidence" else name]
        assert np.array_equal(stored, value, equal_nan=True)
    assert np.isnan(vertices["ms_3"]).any()  # from below nobody looked


def test_ply_in_trimesh(mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    write_mesh(mesh, tmp_path / "mesh.ply")
    back: Any = trimesh.load(tmp_path / "mesh.ply", process=False)
    raw = back.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(raw["pol_axis_z"].ravel(), mesh.vertex_attributes["pol_axis_z"], equal_nan=True)
    assert np.array_equal(back.faces, mesh.faces) and back.is_watertight
    assert np.abs(back.vertex_normals - mesh.vertex_normals).max() < 1e-6
    visual: Any = mesh.visual
    assert np.array_equal(back.visual.vertex_colors, visual.vertex_colors)


def test_ply_in_meshlab(mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    pymeshlab = pytest.importorskip("pymeshlab")
    for suffix in (".ply", ".glb"):
        write_mesh(mesh, tmp_path / f"mesh{suffix}")
        meshes = pymeshlab.MeshSet()
        meshes.load_new_mesh(str(tmp_path / f"mesh{suffix}"))
        back = meshes.current_mesh()
        assert np.array_equal(back.face_matrix(), mesh.faces) and np.abs(back.vertex_matrix() - mesh.vertices).max() < 1e-6
        visual: Any = mesh.visual
        assert np.abs(back.vertex_color_matrix() - visual.vertex_colors / 255).max() < 1e-6
        if suffix == ".ply":
            assert np.abs(back.vertex_scalar_array() - mesh.vertex_attributes["confidence"]).max() < 1e-6


def glb_parts(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk, by the letter of glTF 2.0."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    binary_size, binary_kind = struct.unpack_from("<I4s", data, 20 + size)
    assert binary_kind == b"BIN\0"
    return json.loads(data[20 : 20 + size]), data[28 + size : 28 + size + binary_size]


def test_gltf_by_the_letter(mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    write_mesh(mesh, tmp_path / "mesh.glb")
    content, binary = glb_parts(tmp_path / "mesh.glb")
    (primitive,) = content["meshes"][0]["primitives"]
    names = {"_" + key.upper() for key in mesh.vertex_attributes}
    assert set(primitive["attributes"]) == names | {"POSITION", "NORMAL", "COLOR_0"}

    def array(name: str, width: int) -> np.ndarray:
        accessor = content["accessors"][primitive["attributes"][name]]
        view = content["bufferViews"][accessor["bufferView"]]
        assert accessor["componentType"] == 5126 and accessor["count"] == len(mesh.vertices)
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return np.frombuffer(binary, "<f4", width * len(mesh.vertices), start).reshape(-1, width)

    assert np.array_equal(array("POSITION", 3), mesh.vertices.astype(np.float32))
    for key, value in mesh.vertex_attributes.items():
        stored = array("_" + key.upper(), 1)[:, 0]
        assert np.isfinite(stored).all()  # glTF has no NaN
        assert np.array_equal(stored[np.isfinite(value)], value[np.isfinite(value)])
    unseen = array("_VIEWS", 1)[:, 0] == 0
    assert unseen.any() and (array("_MS_3", 1)[unseen] == 0).all()
    text = json.dumps(content)
    assert '"unit": "m"' in text and "wavelength_nm 572" in text and '"frame"' in text


def test_gltf_in_trimesh(mesh: trimesh.Trimesh, tmp_path: Path) -> None:
    write_mesh(mesh, tmp_path / "mesh.glb")
    loaded: Any = trimesh.load(tmp_path / "mesh.glb", process=False)
    (back,) = loaded.geometry.values()
    assert np.array_equal(back.vertex_attributes["_RGB_1"].ravel(), np.nan_to_num(mesh.vertex_attributes["rgb_1"]))
    assert back.metadata["unit"] == "m" and np.allclose(back.bounds, mesh.bounds, atol=1e-6)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb"])
def test_geometry_comes_back(tmp_path: Path, suffix: str) -> None:
    mesh = extract_mesh(AnalyticField(sphere(), [MONO]), MeshOptions(24))  # type: ignore[arg-type]
    write_mesh(mesh, tmp_path / f"mesh{suffix.upper()}")
    back = trimesh.load(tmp_path / f"mesh{suffix.upper()}", force="mesh")
    assert len(back.faces) == len(mesh.faces)
    assert np.allclose(back.bounds, mesh.bounds, atol=1e-6)
    assert back.volume == pytest.approx(mesh.volume, rel=1e-5)  # the same way round
    if suffix != ".glb":
        assert b"unit m" in (tmp_path / f"mesh{suffix.upper()}").read_bytes()[:300].replace(b":", b"")


def test_far_from_the_origin_positions_are_double(tmp_path: Path) -> None:
    centre = (4.5e5, 5.1e6, 300.0)  # metres of a map
    field = AnalyticField(sphere(0.6, centre), [MONO], Region(centre, 1.0))
    field.unit = "map metre, ±1"
    mesh = extract_mesh(field, MeshOptions(24))  # type: ignore[arg-type]
    write_mesh(mesh, tmp_path / "far.ply")
    comments, vertices, _ = read_ply(tmp_path / "far.ply")
    assert vertices.dtype["x"] == np.float64 and "unit map metre, ?1" in comments
    at = np.stack([vertices[c] for c in "xyz"], -1) - np.array(centre)
    assert np.abs(np.linalg.norm(at, axis=1) - 0.6).max() < 1e-4


def test_bad_files(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(1)
    with pytest.raises(InputError, match=r"mesh.txt: unknown mesh type '.txt', expected one of .ply"):
        write_mesh(ball, tmp_path / "mesh.txt")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="could not be written"):
        write_mesh(ball, tmp_path / "file" / "mesh.ply")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
