"""The scene around what a browser sees: cameras, region, rig, points, mesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mmsynth.scene.load import sparse_points
from mmsynth.scene.scene import Frame
from mmsynth.viewer.placing import fov_of, quaternion, to_browser

if TYPE_CHECKING:
    from mmsynth.viewer.viewer import Session, Viewer

_COLOURS = ((230, 90, 60), (60, 140, 230), (70, 180, 90), (200, 120, 220), (230, 180, 50), (90, 200, 200))
_GIVEN = (150, 150, 150)
_SIZE = 0.12  # of a camera, radii
_MOST_CAMERAS = 2000


def frame_name(frame: Frame) -> str:
    return f"{frame.sensor} {frame.view:04d}"


class Stage:
    """What stands in one browser's world beside the field.

    Attributes:
        visible: whether anything does. on_camera: called with the frame of a camera that was clicked. mesh_file: of the run, if it has one.
    """

    def __init__(self, viewer: Viewer, session: Session) -> None:
        self._viewer, self._session = viewer, session
        self._shown: dict[str, list[Any]] = {}
        self.on_camera: Callable[[Frame], None] = lambda frame: None
        self._points = None if viewer.scene is None else sparse_points(viewer.scene)
        self.has_points = self._points is not None
        meshes = [viewer.folder / f"mesh{suffix}" for suffix in (".ply", ".glb", ".obj", ".stl")]
        self.mesh_file: Path | None = next((path for path in meshes if path.is_file()), None)

    @property
    def visible(self) -> bool:
        return bool(self._shown)

    def show_region(self, on: bool) -> None:
        self._toggle(
            "region", on, lambda: [self._scene.add_icosphere("/region", 1.0, color=(120, 160, 220), wireframe=True, subdivisions=2)]
        )

    def show_cameras(self, sensor: str, on: bool) -> None:
        self._toggle(f"cameras/{sensor}", on, lambda: self._cameras(sensor, given=False))

    def show_given(self, on: bool) -> None:
        scene = self._viewer.scene
        assert scene is not None
        self._toggle("given", on, lambda: [handle for name in scene.sensors for handle in self._cameras(name, given=True)])

    def show_rig(self, on: bool) -> None:
        self._toggle("rig", on, self._rig)

    def show_points(self, on: bool) -> None:
        points = self._points
        assert points is not None
        place = lambda: to_browser(self._viewer.field, points.positions).astype(np.float32)
        self._toggle("points", on, lambda: [self._scene.add_point_cloud("/points", place(), points.colours, point_size=0.008)])

    def show_mesh(self, on: bool) -> None:
        self._toggle("mesh", on, self._mesh)

    @property
    def _scene(self) -> Any:
        return self._session.client.scene

    def _toggle(self, name: str, on: bool, add: Callable[[], list[Any]]) -> None:
        if on and name not in self._shown:
            self._shown[name] = add()
        elif not on:
            for handle in self._shown.pop(name, []):
                handle.remove()

    def _cameras(self, sensor: str, given: bool) -> list[Any]:
        scene, field = self._viewer.scene, self._viewer.field
        assert scene is not None
        colour = _GIVEN if given else _COLOURS[list(scene.sensors).index(sensor) % len(_COLOURS)]
        handles = []
        for frame in scene.frames_of(sensor)[:_MOST_CAMERAS]:
            pose = frame.camera_to_world if given else field.pose_of(frame)
            handle = self._scene.add_camera_frustum(
                f"/{'given' if given else 'cameras'}/{frame_name(frame).replace(' ', '/')}",
                fov=fov_of(frame.camera),
                aspect=frame.camera.width / frame.camera.height,
                scale=_SIZE,
                thickness=1.5,
                thickness_units="screen",
                color=colour,
                wxyz=quaternion(pose[:3, :3]),
                position=to_browser(field, pose[:3, 3]),
            )
            if not given:
                handle.on_click(lambda _, frame=frame: self.on_camera(frame))
            handles.append(handle)
        return handles

    def _rig(self) -> list[Any]:
        scene, field = self._viewer.scene, self._viewer.field
        assert scene is not None
        view = scene.frames[0].view
        handles = []
        for name in scene.sensors:
            for frame in scene.frames_of(name, (view,)):
                pose = field.pose_of(frame)
                place: dict[str, Any] = {"wxyz": quaternion(pose[:3, :3]), "position": to_browser(field, pose[:3, 3])}
                handles.append(self._scene.add_frame(f"/rig/{name}", axes_length=0.08, axes_radius=0.003, **place))
                handles.append(self._scene.add_label(f"/rig/{name}/label", name))
        return handles

    def _mesh(self) -> list[Any]:
        import trimesh  # takes its time

        assert self.mesh_file is not None
        mesh = trimesh.load_mesh(self.mesh_file)
        mesh.vertices = to_browser(self._viewer.field, mesh.vertices)
        return [self._scene.add_mesh_trimesh("/mesh", mesh)]
