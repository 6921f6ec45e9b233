"""Paths: key poses set in the browser, flown through, saved as poses and as videos."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import write_json
from mmsynth.operations.views.trajectories import through
from mmsynth.operations.views.video import video_steps
from mmsynth.scene.layouts.nerfstudio import transforms_content
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import resized
from mmsynth.viewer.placing import fov_of, quaternion, to_browser

if TYPE_CHECKING:
    from mmsynth.viewer.viewer import Session, Viewer

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_PREVIEW_PER_SECOND = 12


def add_path_panel(viewer: Viewer, session: Session) -> None:
    gui, client = session.client.gui, session.client
    keys: list[PosedCamera] = []
    drawn: list[Any] = []
    told = gui.add_markdown("No key poses yet: fly somewhere and add one.")
    add = gui.add_button("Add key pose here")
    remove = gui.add_button("Remove the last one")
    seconds = gui.add_number("Seconds", 4.0, min=0.1, max=600.0, step=0.5)
    rate = gui.add_number("Pictures a second", 24, min=1, max=120, step=1)
    width = gui.add_number("Width [px]", 320, min=16, max=3840, step=16)
    name = gui.add_text("Name", "path", hint="of the files: letters, digits, - and _")
    play = gui.add_button("Fly along it")
    save = gui.add_button("Save poses", hint="for generate-dataset, convert, simulate and video")
    film = gui.add_button("Save video", hint="of what is shown, both sides of the wipe beside each other")
    written = gui.add_markdown("")

    def along(count: int) -> list[PosedCamera]:
        if len(keys) < 2:
            raise InputError("path: it takes two key poses or more.")
        return through(keys, count, viewer.field.region.radius)

    def file_of(folder: str, suffix: str) -> Path:
        if not _NAME.fullmatch(name.value):
            raise InputError(f"name {name.value[:70]!r}: expected letters, digits, - and _, at most 64.")
        return viewer.folder / folder / f"{name.value}{suffix}"

    def changed() -> None:
        for handle in drawn:
            handle.remove()
        drawn.clear()
        for i, key in enumerate(keys):
            pose = key.camera_to_world
            place: dict[str, Any] = {"wxyz": quaternion(pose[:3, :3]), "position": to_browser(viewer.field, pose[:3, 3])}
            drawn.append(
                client.scene.add_camera_frustum(
                    f"/path/{i}",
                    fov=fov_of(key.camera),
                    aspect=key.camera.width / key.camera.height,
                    scale=0.15,
                    color=(250, 250, 90),
                    **place,
                )
            )
        if len(keys) > 1:
            points = to_browser(viewer.field, np.stack([view.camera_to_world[:3, 3] for view in along(100)]))
            segments = np.stack([points[:-1], points[1:]], 1).astype(np.float32)
            drawn.append(client.scene.add_line_segments("/path/line", segments, (250, 250, 90)))
        told.content = f"{len(keys)} key pose{'s' * (len(keys) != 1)}."

    def guarded(action: Any) -> Any:
        def run(_: Any) -> None:
            try:
                action()
            except InputError as error:
                client.add_notification("Path", str(error), color="red", auto_close_seconds=8.0)

        return run

    def add_key() -> None:
        keys.append(viewer.view_of(session))
        changed()

    def remove_key() -> None:
        if keys:
            keys.pop()
        changed()

    def views() -> list[PosedCamera]:
        found = along(max(2, round(seconds.value * rate.value)))
        return [PosedCamera(resized(view.camera, int(width.value)), view.camera_to_world, view.name) for view in found]

    def fly() -> None:
        for view in along(max(2, round(seconds.value * _PREVIEW_PER_SECOND))):
            if client.client_id not in viewer.sessions:
                return
            viewer.stand_at(session, view)
            time.sleep(1.0 / _PREVIEW_PER_SECOND)

    def save_poses() -> None:
        path = file_of("paths", ".json")
        write_json(path, transforms_content(views()))
        written.content = f"wrote `{path}`"

    def save_video() -> None:
        path = file_of("videos", ".mp4")
        wanted = session.looking.wanted
        viewer.do(_film(viewer, views(), list(wanted.displays), path, float(rate.value), written))

    add.on_click(guarded(add_key))
    remove.on_click(guarded(remove_key))
    play.on_click(guarded(fly))
    save.on_click(guarded(save_poses))
    film.on_click(guarded(save_video))


def _film(viewer: Viewer, views: list[PosedCamera], displays: list[Any], path: Path, rate: float, written: Any) -> Iterator[None]:
    try:
        for done, total in video_steps(viewer.field, views, displays, path, rate, colours=viewer.colours, training=viewer.training):
            written.content = f"{done} of {total} pictures"
            yield
        written.content = f"wrote `{path}`"
    except InputError as error:
        written.content = f"**{error}**"
