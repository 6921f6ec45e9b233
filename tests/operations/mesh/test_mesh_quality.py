"""What a mesh is and how far it is from another: closed forms, other implementations, and culling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from analytic import AnalyticField, ring_pose, sphere
from conftest import look_at
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from mmsynth.errors import InputError
from mmsynth.operations.mesh.quality import compare_meshes, describe_mesh, load_reference
from mmsynth.operations.mesh.topology import components, topology
from mmsynth.scene.scene import PosedCamera, Region
from mmsynth.sensors.camera import Camera

CAMERA = Camera(96, 72, 104.0, 104.0, 46.7, 35.9, (-0.1, 0.05, 0.001, -0.002))
RING = [PosedCamera(CAMERA, ring_pose(i, 8)) for i in range(8)]


def ball(radius: float = 0.6, at: tuple[float, float, float] = (0.0, 0.0, 0.0), fine: int = 4) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(fine, radius).apply_translation(at)


def test_description_of_closed_forms() -> None:
    report = describe_mesh(ball(), AnalyticField(sphere(0.6)).sdf, 0.05)
    assert report["watertight"] and report["euler_number"] == 2 and report["components"] == 1 and report["boundary_edges"] == 0
    assert report["volume"] == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.01)
    assert report["area"] == pytest.approx(4 * np.pi * 0.36, rel=0.01)
    assert np.allclose(report["bounds"], [[-0.6] * 3, [0.6] * 3], atol=1e-3)
    assert report["residual"]["max"] < 1e-6 and report["residual"]["max_cells"] == report["residual"]["max"] / 0.05
    assert 1e-4 < report["residual"]["faces_rms"] < 2e-3  # chords are inside
    two = trimesh.util.concatenate([ball(fine=2), trimesh.creation.torus(0.5, 0.1).apply_translation([3.0, 0.0, 0.0])])
    assert (describe_mesh(two)["components"], describe_mesh(two)["euler_number"]) == (2, 2)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 3), st.lists(st.integers(0, 10**6), max_size=4), st.booleans())
def test_topology_agrees_with_trimesh(kind: int, holes: list[int], flip: bool) -> None:
    mesh = [ball(fine=2), trimesh.creation.torus(1.0, 0.3, 16, 8), trimesh.creation.box(), trimesh.creation.annulus(0.3, 1.0, 1.0)][kind]
    faces = np.delete(mesh.faces, [h % len(mesh.faces) for h in holes], axis=0)
    if flip:
        faces[0] = faces[0][::-1]
    other = trimesh.Trimesh(mesh.vertices, faces, process=False)
    other.remove_unreferenced_vertices()
    found = topology(other.faces)
    assert found.euler_number == other.euler_number
    assert found.closed == (other.is_watertight and other.is_winding_consistent)
    assert found.boundary == (np.bincount(other.edges_unique_inverse) == 1).sum()
    assert components(other.faces, len(other.vertices)).max() + 1 == other.body_count


def test_two_balls_are_as_far_apart_as_their_radii() -> None:
    scores = compare_meshes(ball(0.6, fine=5), ball(0.63, fine=5), distances=[0.02, 0.04], samples=20_000)
    for key in ("accuracy", "completeness", "chamfer", "accuracy_median"):
        assert scores[key] == pytest.approx(0.03, abs=3e-4)
    assert scores["f_score"] == {"0.02": 0.0, "0.04": 1.0}
    assert scores["normal_consistency"] == pytest.approx(1.0, abs=1e-3)


def test_a_mesh_is_at_no_distance_from_itself_however_few_points() -> None:
    """Points alone, 500 on a ball of 0.6, would say 0.03."""
    assert compare_meshes(ball(fine=2), ball(fine=2), samples=500)["chamfer"] < 1e-4
    inside_out = ball(fine=3)
    inside_out.invert()
    assert compare_meshes(inside_out, ball(fine=3), samples=5_000)["normal_consistency"] < -0.95


def test_distances_are_those_of_a_search_among_many_points() -> None:
    rough, smooth = ball(0.6, fine=1), ball(0.6, (0.05, 0.0, 0.0), fine=4)
    scores = compare_meshes(rough, smooth, samples=20_000)
    a, b = (trimesh.sample.sample_surface(m, 400_000, seed=0)[0] for m in (rough, smooth))
    assert scores["accuracy"] == pytest.approx(cKDTree(b).query(a[::10])[0].mean(), rel=0.02)
    assert scores["completeness"] == pytest.approx(cKDTree(a).query(b[::10])[0].mean(), rel=0.02)


def test_only_the_region_counts() -> None:
    both = trimesh.util.concatenate([ball(0.3), ball(0.3, (3.0, 0.0, 0.0))])
    assert compare_meshes(ball(0.3), both, samples=20_000)["completeness"] > 1.0
    scores = compare_meshes(ball(0.3), both, region=Region((0.0, 0.0, 0.0), 1.0), samples=20_000)
    assert scores["reference_in_region"] == pytest.approx(0.5, abs=0.02)
    assert scores["chamfer"] < 1e-4 and scores["points"][1] == pytest.approx(10_000, rel=0.05)
    with pytest.raises(InputError, match="nothing of the mesh in the region"):
        compare_meshes(ball(0.3), both, region=Region((9.0, 0.0, 0.0), 1.0), samples=1000)


def test_what_no_view_sees_does_not_count() -> None:
    """The reference has a hollow that cameras cannot look into, the mesh none."""
    hollow = trimesh.util.concatenate([ball(0.6), ball(0.3)])
    blind = compare_meshes(ball(0.6), hollow, samples=40_000)
    assert blind["completeness"] > 0.05
    seeing = compare_meshes(ball(0.6), hollow, views=RING, samples=40_000)
    assert seeing["completeness"] < 1e-4 and seeing["accuracy"] < 1e-4
    assert 0 < seeing["points"][0] < 40_000


def test_what_the_reference_says_nothing_about_does_not_count() -> None:
    """A mesh with a table, against the ball alone that stands on it."""
    table = trimesh.creation.box([3.0, 3.0, 0.1]).subdivide().subdivide().apply_translation([0.0, 0.0, -0.65])
    scene = trimesh.util.concatenate([ball(0.6), table])
    assert compare_meshes(scene, ball(0.6), samples=40_000)["accuracy"] > 0.2
    scores = compare_meshes(scene, ball(0.6), views=RING, samples=40_000)
    assert scores["accuracy"] < 0.01 and scores["completeness"] < 1e-3
    # what floats where views should see the ball is not excused
    floater = trimesh.util.concatenate([ball(0.6), ball(0.1, (0.9, 0.0, 0.3))])
    assert compare_meshes(floater, ball(0.6), views=RING, samples=40_000)["accuracy"] > 1e-3
    with pytest.raises(InputError, match=r"nothing of the mesh .* that the views see"):
        compare_meshes(ball(0.6), ball(0.6), views=[PosedCamera(CAMERA, look_at((3.0, 0.0, 0.0), (6.0, 0.0, 0.0)))], samples=1000)


def test_references_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gt.ply: no such file"):
        load_reference(tmp_path / "gt.ply")
    (tmp_path / "text.ply").write_text("no mesh")
    with pytest.raises(InputError, match=r"text.ply"):
        load_reference(tmp_path / "text.ply")
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(InputError, match="no triangles"):
        load_reference(tmp_path / "points.ply")
    ball().export(tmp_path / "ball.obj")
    assert len(load_reference(tmp_path / "ball.obj").faces) == len(ball().faces)
