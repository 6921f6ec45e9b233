"""The viewer's server, without a browser."""

from __future__ import annotations

import http.client
import socket
from pathlib import Path

import numpy as np
import pytest
from analytic import AnalyticField, ring_pose, scene_of, sphere
from typer.testing import CliRunner

from mmsynth.cli import app
from mmsynth.errors import InputError
from mmsynth.sensors.camera import Camera
from mmsynth.viewer import viewer as module
from mmsynth.viewer.open import open_viewer
from mmsynth.viewer.placing import camera_of, fov_of, pose_of, quaternion, to_browser, to_scene

pytest.importorskip("viser")
FIELD = AnalyticField(sphere())


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def status_of(port: int, path: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path)
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_it_listens_on_this_machine_alone_and_frees_the_port(tmp_path: Path) -> None:
    port = free_port()
    viewer = open_viewer(FIELD, None, tmp_path, port=port)
    try:
        assert viewer.url == f"http://127.0.0.1:{port}"
        assert status_of(port, "/")[0] == 200
        with pytest.raises(InputError, match=f"--port {port}: cannot listen there"):
            open_viewer(FIELD, None, tmp_path, port=port)
        result = CliRunner().invoke(app, ["view", "--port", str(port)])
        assert result.exit_code == 2 and f"--port {port}" in result.stderr and len(result.stderr.splitlines()) == 1
    finally:
        viewer.close()
    again = open_viewer(FIELD, None, tmp_path, port=port)
    again.close()


def test_nothing_but_its_own_page_is_served(tmp_path: Path) -> None:
    (tmp_path / "secret.txt").write_text("secret")
    port = free_port()
    viewer = open_viewer(FIELD, None, tmp_path, port=port)
    try:
        outside = f"/..{tmp_path}/secret.txt", f"/%2e%2e/%2e%2e{tmp_path}/secret.txt", f"//{tmp_path}/secret.txt", "/%2fetc/passwd"
        for path in ("/secret.txt", *outside):
            status, content = status_of(port, path)
            assert b"secret" not in content and b"root:" not in content, path
            assert status in (403, 404), path
    finally:
        viewer.close()


def test_without_viser_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'mmsynth\[view\]'"):
        module.require_free("127.0.0.1", 0)


def test_no_tunnel_is_ever_asked_for(tmp_path: Path) -> None:
    viewer = open_viewer(FIELD, None, tmp_path, port=free_port())
    try:
        assert viewer.server.request_share_url() is None
    finally:
        viewer.close()


def test_what_cannot_be_done_ends_nothing(tmp_path: Path) -> None:
    viewer = open_viewer(FIELD, None, tmp_path, port=free_port())
    done: list[int] = []

    def refused() -> object:
        raise InputError("no.")
        yield

    def counted() -> object:
        for i in range(3):
            done.append(i)
            yield

    try:
        viewer.ask(refused())  # type: ignore[arg-type]
        viewer.do(counted())  # type: ignore[arg-type]
        viewer.do(refused())  # type: ignore[arg-type]
        assert viewer.work(10.0) and done == [0, 1, 2] and not viewer.work(1.0)
    finally:
        viewer.close()


def test_a_glance_without_browsers_costs_nothing(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    viewer = open_viewer(field, None, tmp_path, port=free_port(), live=True)
    field.cast = None  # type: ignore[assignment, method-assign]  # it would be called
    try:
        viewer.glance()
    finally:
        viewer.close()


def test_the_browsers_world_is_the_scene_and_back() -> None:
    pose = ring_pose(1, 7)
    position = to_browser(FIELD, pose[:3, 3])
    np.testing.assert_allclose(to_scene(FIELD, position), pose[:3, 3])
    np.testing.assert_allclose(pose_of(FIELD, quaternion(pose[:3, :3]), position), pose, atol=1e-12)
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
    again = camera_of(640, 480, fov_of(camera))
    np.testing.assert_allclose(again.intrinsics, camera.intrinsics)


def test_it_starts_where_the_first_training_frame_was_taken(tmp_path: Path) -> None:
    scene = scene_of(FIELD, tmp_path / "scene")
    viewer = open_viewer(FIELD, scene, tmp_path, port=free_port())
    try:
        np.testing.assert_allclose(viewer.start.camera_to_world, scene.frames[0].camera_to_world)
        first = viewer.server.initial_camera
        np.testing.assert_allclose(first.position, to_browser(FIELD, scene.frames[0].camera_to_world[:3, 3]))
        axis = np.asarray(first.look_at) - np.asarray(first.position)
        np.testing.assert_allclose(axis / np.linalg.norm(axis), scene.frames[0].camera_to_world[:3, 2], atol=1e-9)
    finally:
        viewer.close()
