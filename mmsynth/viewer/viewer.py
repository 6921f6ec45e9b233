"""A field in browsers.

Browsers leave wishes; everything that touches the field is done by ``Viewer.work``, on the thread that calls it: the compiled kernels take
all cores for one caller, and a fit that is looked at goes on with the same ones.
"""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.operations.output import previews
from mmsynth.operations.views.coverage import TrainingRays, training_rays
from mmsynth.operations.views.displays import Display, exposure_key, exposures_of, find_display, is_light, look
from mmsynth.operations.views.load import reference_camera, training_poses
from mmsynth.operations.views.trajectories import world_up
from mmsynth.report.report import measured_channels
from mmsynth.scene.preview_colours import preview_colours
from mmsynth.scene.scene import Frame, PosedCamera, Scene
from mmsynth.sensors.camera import resized
from mmsynth.viewer.pictures import Looking, Wanted
from mmsynth.viewer.placing import camera_of, fov_of, pose_of, to_browser

if TYPE_CHECKING:
    import viser

_EXPOSED_WIDTH = 96  # pixels of the rendering that exposures are chosen by
_NOTHING = 160.0  # radii: how far away nothing is, for what stands in the browser's world (viser's depth ends at 167)
_FRAMES_KEPT = 48
_LIVE_SHARE = 0.07  # of a fit's time
_LIVE_EVERY = 3.0  # seconds
_LIVE_MOST = 240  # pixels


class Session:
    """One browser: its camera, what it wants to see, and what waits to be sent.

    Attributes:
        objects: whether things stand in its world, for which it needs depths.
    """

    def __init__(self, client: viser.ClientHandle, wanted: Wanted) -> None:
        self.client = client
        self.looking = Looking(wanted)
        self.show = False
        self.objects = False
        self.moved = 0.0
        self.latency: deque[float] = deque(maxlen=1000)  # seconds from a move to its first picture


class Viewer:
    """A server for browsers.

    Attributes:
        field, scene, folder: of a run; the scene is None where it is gone. server: viser's. sessions: the browsers that are connected.
    """

    def __init__(
        self,
        field: Field,
        scene: Scene | None,
        folder: Path,
        *,
        host: str,
        port: int,
        live: bool,
        add_panels: Callable[[Viewer, Session], None],
    ) -> None:
        """Listen; ``open_viewer`` is for users.

        Args:
            add_panels: called for every browser that connects.
        Raises:
            InputError: viser is not installed, or the port is taken.
        """
        require_free(host, port)
        viser = _viser()
        self.field, self.scene, self.folder, self.live = field, scene, folder, live
        self._add_panels = add_panels
        self.sessions: dict[int, Session] = {}
        self._questions: deque[Iterator[Any]] = deque()
        self._jobs: deque[Iterator[Any]] = deque()
        self._wake = threading.Condition()
        self._closed = False
        self._training: TrainingRays | None = None
        self._exposures: dict[str, float] = {}
        self._depth: tuple[float, float] | None = None
        self._turn = 0
        self._spent, self._began, self._refreshed = 0.0, time.perf_counter(), 0.0
        self._previews = lru_cache(maxsize=_FRAMES_KEPT)(self._preview_of)
        poses = [] if scene is None else training_poses(field, scene)
        self.up = world_up(poses)
        self.start = _start(field, poses, self.up)
        self.colours = {} if scene is None else preview_colours(scene)
        with contextlib.redirect_stdout(io.StringIO()):  # viser's own greeting
            self.server = viser.ViserServer(host=host, port=port, label="mmsynth", verbose=False)
        self.server.request_share_url = _no_tunnel  # type: ignore[method-assign]
        self.server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self.server.scene.set_up_direction(tuple(self.up))
        self.server.scene.world_axes.visible = False
        self.host, self.port = host, port
        first = self.server.initial_camera
        first.position, first.look_at = (
            tuple(to_browser(field, self.start.camera_to_world[:3, 3])),
            tuple(self._aim(self.start.camera_to_world)),
        )
        first.up, first.fov = tuple(self.up), fov_of(self.start.camera)
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnect)

    @property
    def url(self) -> str:
        return f"http://{self.host}:{self.port}"

    # ------------------------------------------------------------------------------------------------- called by anybody

    def ask(self, steps: Iterator[Any]) -> None:
        """Have something short done at once: a generator, run to its end; a picture that is getting finer waits."""
        with self._wake:
            self._questions.append(steps)
            self._wake.notify_all()

    def do(self, steps: Iterator[Any]) -> None:
        """Have something long done: a generator, advanced between pictures until it ends."""
        with self._wake:
            self._jobs.append(steps)
            self._wake.notify_all()

    def wake(self) -> None:
        with self._wake:
            self._wake.notify_all()

    def wait(self, seconds: float) -> None:
        """Until somebody wants something, or so long."""
        with self._wake:
            if not self._pending():
                self._wake.wait(seconds)

    def close(self) -> None:
        """Disconnect everybody; the port is free then."""
        if not self._closed:
            self._closed = True
            with contextlib.redirect_stdout(io.StringIO()):
                self.server.stop()

    def wish(self, session: Session, **changes: Any) -> None:
        """A browser wants to see something else: fields of ``Wanted``."""
        if session.looking.wish(replace(session.looking.wanted, **changes)):
            session.show = True
        self.wake()

    def stand_at(self, session: Session, view: PosedCamera) -> None:
        """Move a browser's camera."""
        camera, pose = session.client.camera, view.camera_to_world
        with session.client.atomic():
            camera.position = to_browser(self.field, pose[:3, 3])
            camera.look_at = self._aim(pose)
            camera.up_direction = -pose[:3, 1]
            camera.fov = fov_of(view.camera)

    def view_of(self, session: Session) -> PosedCamera:
        """Where a browser's camera stands, at full size."""
        camera = session.client.camera
        view = camera_of(max(1, camera.image_width), max(1, camera.image_height), camera.fov)
        return PosedCamera(view, pose_of(self.field, camera.wxyz, camera.position))

    # ------------------------------------------------------------------------------------- on the thread that owns the field

    def work(self, seconds: float) -> bool:
        """Do what is wanted, for about so long; whether anything was."""
        until = time.perf_counter() + seconds
        did = False
        while not self._closed and self._one():
            did = True
            if time.perf_counter() >= until:
                break
        return did

    def glance(self) -> None:
        """What a fit calls after every step: some pictures of the field as it is, for a small share of its time."""
        now = time.perf_counter()
        if not self.sessions or self._spent > _LIVE_SHARE * (now - self._began):
            return
        if now - self._refreshed > _LIVE_EVERY and not self._pending():
            self._refreshed = now
            self._exposures, self._depth = {}, None
            for session in list(self.sessions.values()):
                session.looking.again()
        self._one()
        self._spent += time.perf_counter() - now

    def exposure(self, display: Display) -> float:
        """Under which a modality is well lit where the first training view sees it; 1 of what is no light."""
        if not is_light(display):
            return 1.0
        key = exposure_key(display)
        if key not in self._exposures:
            seen = look(
                self.field, _narrow(self.start), [display, *([] if len(display.modalities) > 1 else [find_display(self.field, key)])]
            )
            assert seen is not None
            self._exposures |= exposures_of(self.field, [display], seen, self.colours)
        return self._exposures[key]

    def depth_range(self) -> tuple[float, float] | None:
        """Nearest and farthest that the first training view sees [radii], a little more than that."""
        if self._depth is None:
            seen = look(self.field, _narrow(self.start), [find_display(self.field, "depth")])
            assert seen is not None
            hit = seen["depth"][np.isfinite(seen["depth"])]
            if hit.size:
                near, far = np.percentile(hit, (2.0, 98.0))
                self._depth = 0.8 * float(near), 1.2 * float(far)
        return self._depth

    def depth_shown(self) -> tuple[float, float] | None:
        """The same in the scene's unit, None where it is not known yet; called by anybody."""
        return None if self._depth is None else (self._depth[0] * self.field.region.radius, self._depth[1] * self.field.region.radius)

    def linear_of_frame(self, frame: Frame) -> np.ndarray:
        """A frame's preview, linear and not exposed, (H, W, 3)."""
        assert self.scene is not None
        sensor = self.scene.sensors[frame.sensor]
        return previews.preview_linear(sensor, measured_channels(sensor, frame, self.scene.masks), self.colours.get(frame.sensor))

    def training(self) -> TrainingRays | None:
        """The training frames' depth maps, made when they are first asked for; of a field that still changes there are none."""
        if self._training is None and self.scene is not None and not self.live:
            for session in self.sessions.values():
                session.client.add_notification("Coverage", "The training frames' depth maps are made, once.", auto_close_seconds=8.0)
            self._training = training_rays(self.field, self.scene, modalities=[n for n in self.field.measured if n in self.scene.sensors])
        return self._training

    def _pending(self) -> bool:
        return bool(self._questions or self._jobs) or any(s.show or not s.looking.finished for s in list(self.sessions.values()))

    def _one(self) -> bool:
        """One thing that is wanted: a picture to be shown, a coarse one to be rendered, a question, a step of a job or a finer picture."""
        sessions = list(self.sessions.values())
        for session in sessions:
            if session.show:
                self._send(session)
                return True
        self._turn += 1
        sessions = sessions[self._turn % max(1, len(sessions)) :] + sessions[: self._turn % max(1, len(sessions))]
        coarse = [s for s in sessions if s.looking.coarse and s.looking.view is not None]
        if not coarse and self._questions:
            self._guarded(self._questions.popleft(), to_the_end=True)
            return True
        unfinished = [s for s in sessions if not s.looking.finished]
        if not coarse and self._jobs and (self._turn % 2 or not unfinished):
            self._step_of_job()
            return True
        for session in coarse or unfinished:
            if session.looking.finer(self.field, self.training, lambda: not self._questions):
                self._send(session)
            return True
        return False

    def _step_of_job(self) -> None:
        with self._wake:
            job = self._jobs.popleft()
        if self._guarded(job):
            with self._wake:
                self._jobs.append(job)

    def _guarded(self, steps: Iterator[Any], to_the_end: bool = False) -> bool:
        """Take a step, or all: whether more are left. What cannot be read or written is said to everybody, and nothing ends."""
        try:
            for _ in steps:
                if not to_the_end:
                    return True
        except InputError as error:
            for session in list(self.sessions.values()):
                session.client.add_notification("Error", str(error), color="red", auto_close_seconds=8.0)
        return False

    def _send(self, session: Session) -> None:
        session.show = False
        looking = session.looking
        shown = looking.picture(self.field, self.exposure, self.colours, self.depth_range())
        if shown is None or looking.seen is None or session.client.client_id not in self.sessions:
            return
        depth = None
        if session.objects and "depth_z" in looking.seen:
            found = looking.seen["depth_z"]
            depth = np.where(np.isfinite(found), found, _NOTHING).astype(np.float32)
        quality = 95 if looking.finished else 80
        session.client.scene.set_background_image(shown, format="jpeg", jpeg_quality=quality, depth=depth)
        session.client.flush()
        if session.moved:
            session.latency.append(time.perf_counter() - session.moved)
            session.moved = 0.0

    def pixels_of(self, frame: Frame) -> np.ndarray:
        """A frame's preview, (H, W, 3) uint8; the last ones are kept."""
        return self._previews(frame.sensor, frame.view)

    def _preview_of(self, name: str, view: int) -> np.ndarray:
        assert self.scene is not None
        sensor, (frame, *_) = self.scene.sensors[name], self.scene.frames_of(name, (view,))
        return previews.preview_rgb(sensor, measured_channels(sensor, frame, self.scene.masks), None, self.colours.get(frame.sensor))

    # ------------------------------------------------------------------------------------------------------------- browsers

    def _connect(self, client: viser.ClientHandle) -> None:
        first = find_display(self.field, next(iter(self.field.sensors)))
        session = Session(client, Wanted(first, first, most=_LIVE_MOST if self.live else 1920))
        self._add_panels(self, session)
        self.sessions[client.client_id] = session

        @client.camera.on_update
        def _(_: Any) -> None:
            if not session.moved:
                session.moved = time.perf_counter()
            session.looking.move(self.view_of(session))
            self.wake()

        session.looking.move(self.view_of(session))
        self.wake()

    def _disconnect(self, client: viser.ClientHandle) -> None:
        self.sessions.pop(client.client_id, None)

    def _aim(self, pose: np.ndarray) -> np.ndarray:
        """What a camera (4, 4) turns around: the point of its axis that is nearest to the region's centre, before it."""
        eye = to_browser(self.field, pose[:3, 3])
        return eye + max(0.1, float(-eye @ pose[:3, 2])) * pose[:3, 2]


def _viser() -> Any:
    try:
        import viser
    except ImportError:
        raise InputError("view: viser is not installed; it comes with `pip install 'mmsynth[view]'`.") from None
    return viser


def require_free(host: str, port: int) -> None:
    """Viser would take the next port, and nobody would know which.

    Raises:
        InputError: viser is not installed, or the port is taken.
    """
    _viser()
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(f"--host {host} --port {port}: cannot listen there ({why}), expected a free port of this machine.") from error


def _no_tunnel(*_: Any, **__: Any) -> None:
    """Viser could ask a server of its makers for a public address; nothing here leaves the machine."""


def _start(field: Field, poses: list[np.ndarray], up: np.ndarray) -> PosedCamera:
    from mmsynth.operations.views.trajectories import look_at
    from mmsynth.sensors.camera import Camera

    try:
        camera = replace(reference_camera(field), distortion=(), lens="brown_conrady")
    except InputError:
        camera = Camera(160, 120, 160.0, 160.0, 79.5, 59.5)
    if poses:
        return PosedCamera(camera, poses[0])
    side = np.eye(3)[np.abs(up).argmin()]
    centre = np.array(field.region.centre)
    return PosedCamera(camera, look_at(centre + 3.0 * field.region.radius * side, centre, up))


def _narrow(view: PosedCamera) -> PosedCamera:
    return PosedCamera(resized(view.camera, min(_EXPOSED_WIDTH, view.camera.width)), view.camera_to_world)
