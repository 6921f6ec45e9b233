"""Fewer faces: the number or the error asked for, closed meshes stay closed, and it works without pymeshlab."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest
import trimesh
from analytic import MONO, AnalyticField, Distance, sphere, torus

from mmsynth.errors import InputError
from mmsynth.operations.mesh import decimation
from mmsynth.operations.mesh.decimation import decimate_to, decimate_within
from mmsynth.operations.mesh.extract import MeshOptions, extract_mesh
from mmsynth.operations.mesh.topology import topology

BACKENDS = ["fast-simplification", *(["pymeshlab"] if importlib.util.find_spec("pymeshlab") else [])]


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param != "pymeshlab":
        monkeypatch.setattr(decimation.importlib.util, "find_spec", lambda name: None)
    return request.param


def mesh_of(distance: Distance, resolution: int = 48, **options: Any) -> trimesh.Trimesh:
    return extract_mesh(AnalyticField(distance, [MONO]), MeshOptions(resolution, 16, **options))  # type: ignore[arg-type]


@pytest.mark.parametrize(("distance", "euler"), [(sphere(0.6), 2), (torus(), 0)])
@pytest.mark.parametrize("faces", [4000, 1000, 300])
def test_as_many_faces_as_asked_on_the_surface_and_closed(backend: str, distance: Distance, euler: int, faces: int) -> None:
    mesh = mesh_of(distance, faces=faces)
    assert 0.9 * faces <= len(mesh.faces) <= faces
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == euler and mesh.volume > 0
    assert np.abs(distance(mesh.vertices)).max() < 1e-3 * 2 / 48  # moved back onto the zero
    assert np.abs(distance(mesh.triangles_center)).max() < 10.0 / faces  # chords: the area of a face over the radii


@pytest.mark.parametrize("error", [0.02, 0.004])
def test_as_few_faces_as_the_error_allows(backend: str, error: float) -> None:
    mesh = mesh_of(torus(), max_error=error)
    off = np.abs(torus()(mesh.triangles_center))
    assert np.quantile(off, 0.999) <= error
    assert np.quantile(off, 0.999) > 0.3 * error  # not many more than needed
    assert mesh.is_watertight and len(mesh.faces) < 0.5 * len(mesh_of(torus()).faces)


def test_an_error_below_that_of_the_mesh_itself_leaves_it() -> None:
    whole = mesh_of(torus())
    assert len(mesh_of(torus(), max_error=1e-9).faces) == len(whole.faces)


def test_an_open_border_is_kept(backend: str) -> None:
    plane = lambda p: p[..., 2] - 0.1 * p[..., 0]
    mesh = mesh_of(plane, faces=500)
    # a ragged border takes many faces, and fast-simplification cuts its corners
    assert len(mesh.faces) <= 1000 and mesh.area == pytest.approx(np.pi, rel=0.01 if backend == "pymeshlab" else 0.06)
    assert topology(mesh.faces).crowded == 0


def test_more_faces_than_there_are_is_all_of_them() -> None:
    mesh = mesh_of(sphere(0.6))
    assert len(mesh_of(sphere(0.6), faces=10**6).faces) == len(mesh.faces)


def test_far_from_the_origin(backend: str) -> None:
    ball = trimesh.creation.icosphere(4, 0.6)
    shift = np.array([4.5e5, 5.1e6, 300.0])
    v, f = decimate_to((ball.vertices + shift, np.asarray(ball.faces)), 500)
    assert len(f) <= 500 and np.abs(np.linalg.norm(v - shift, axis=1) - 0.6).max() < 0.02


def test_a_result_that_is_not_sound_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever thresholds: here every result has a face too many."""
    import fast_simplification

    ball = trimesh.creation.icosphere(3)
    monkeypatch.setattr(decimation.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(fast_simplification, "simplify", lambda v, f, **_: (v, np.concatenate([f[:99], f[:1]])))
    with pytest.raises(InputError, match=r"from 1,280 to 100 faces without tearing it, expected more faces, or pymeshlab"):
        decimate_to((np.asarray(ball.vertices), np.asarray(ball.faces)), 100)


def test_the_search_for_an_error_ends() -> None:
    ball = trimesh.creation.icosphere(3)
    start = np.asarray(ball.vertices), np.asarray(ball.faces)
    v, f = decimate_within(start, lambda mesh: 0.0, 1.0)
    assert 4 <= len(f) <= 12 and len(v) >= 4
    assert len(decimate_within(start, lambda mesh: 2.0, 1.0)[1]) == len(start[1])
