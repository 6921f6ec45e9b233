"""The panels of one browser: what to show, the pixel that was clicked, the scene around it, paths."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.operations.output import previews
from mmsynth.operations.views.coverage import coverage_of_point
from mmsynth.operations.views.displays import (
    Display,
    at_wavelength,
    bands_of,
    channel_names,
    displays_of,
    find_display,
    label_of,
    linear_of,
    look,
)
from mmsynth.scene.scene import Frame, PosedCamera
from mmsynth.sensors.camera import resized
from mmsynth.viewer.paths import add_path_panel
from mmsynth.viewer.pixel import answer_html, ask
from mmsynth.viewer.stage import Stage, frame_name

if TYPE_CHECKING:
    from mmsynth.viewer.viewer import Session, Viewer

_WAVELENGTH, _FALSE_COLOUR = "wavelength (slider)", "false colour (three bands)"
_SIZES = (240, 480, 960, 1920, 3840)  # of pictures, pixels
_FRAME_WIDTH = 320  # pixels of the pictures of a frame


def add_panels(viewer: Viewer, session: Session) -> None:
    """All panels of a browser that has just connected."""
    client = session.client
    tabs = client.gui.add_tab_group()
    with tabs.add_tab("Show"):
        _add_show_panel(viewer, session)
    with tabs.add_tab("Pixel"):
        _add_pixel_panel(viewer, session)
    with tabs.add_tab("Scene"):
        _add_scene_panel(viewer, session)
    with tabs.add_tab("Path"):
        add_path_panel(viewer, session)


def _add_show_panel(viewer: Viewer, session: Session) -> None:
    gui: Any = session.client.gui
    field = viewer.field
    known = {label_of(field, display): display for display in displays_of(field)}
    bands = bands_of(field)
    names = channel_names(field)
    options = [*known, *([_WAVELENGTH] if len(bands) > 1 else []), *([_FALSE_COLOUR] if len(names) > 2 else [])]
    left = gui.add_dropdown("Show", options, hint="What the picture shows; * marks what a prior predicts")
    right = gui.add_dropdown("Beside it", options, initial_value=options[min(1, len(options) - 1)], hint="On the right of the wipe")
    wipe = gui.add_slider("Wipe", 0.0, 1.0, 0.005, 1.0, hint="Share of the picture on the left; 1: nothing is beside it")
    stops = gui.add_slider("Exposure [stops]", -6.0, 6.0, 0.1, 0.0)
    tone = gui.add_slider("Tone", 0.3, 2.0, 0.05, 1.0, hint="Below 1 dark parts are brighter")
    low, high = (bands[0][0], bands[-1][0]) if len(bands) > 1 else (400.0, 700.0)
    nm = gui.add_slider("Wavelength [nm]", low, high, 1.0, low, visible=False)
    three = [
        gui.add_dropdown(label, names or ["none"], initial_value=(names or ["none"])[i % max(1, len(names))], visible=False)
        for i, label in enumerate(("Red", "Green", "Blue"))
    ]
    most = gui.add_dropdown("Longest side [px]", [str(size) for size in _SIZES], initial_value=str(session.looking.wanted.most))
    legend = gui.add_html("")

    def display_of(option: str) -> Display:
        if option == _WAVELENGTH:
            return at_wavelength(field, min(max(nm.value, low), high))
        if option == _FALSE_COLOUR:
            return find_display(field, "/".join(handle.value for handle in three))
        return known[option]

    def changed(_: Any = None) -> None:
        chosen = (left.value, right.value)
        nm.visible = _WAVELENGTH in chosen
        for handle in three:
            handle.visible = _FALSE_COLOUR in chosen
        try:
            shown = [display_of(option) for option in chosen]
        except InputError as error:
            session.client.add_notification("Cannot be shown", str(error), color="red", auto_close_seconds=6.0)
            return
        legend.content = "".join(_legend(viewer, display) for display in dict.fromkeys(shown[: 1 + (wipe.value < 1.0)]))
        viewer.wish(session, left=shown[0], right=shown[1], wipe=wipe.value, stops=stops.value, tone=tone.value, most=int(most.value))

    for handle in (left, right, wipe, stops, tone, nm, *three, most):
        handle.on_update(changed)
    changed()


def _legend(viewer: Viewer, display: Display) -> str:
    """What the colours of a display mean, as HTML."""
    wrap = '<div role="note" style="padding:.3em .9em;font-size:.8em">{}</div>'
    picture = lambda image, text: (
        f'<img alt="{text}" src="data:image/png;base64,{base64.b64encode(previews.encode_png(image)).decode()}" '
        'style="height:56px;vertical-align:middle;margin-right:.6em">'
    )
    if display.kind == "aolp":
        text = "AoLP is hue: red 0° (image right), green 60°, blue 120°; brightness is DoLP"
        return wrap.format(f"{picture(_wheel(), text)}{text}")
    ramp = np.repeat(np.linspace(0.0, 1.0, 96, dtype=np.float32)[None], 14, 0)
    if display.kind == "depth":
        span = viewer.depth_shown()
        ends = "" if span is None else f": {span[0]:.4g} to {span[1]:.4g} {viewer.field.unit}"
        return wrap.format(f"{picture(previews.preview_share(1.0 - ramp), 'depth')}near to far{ends}")
    if display.kind == "coverage":
        return wrap.format(f"{picture(previews.preview_share(ramp), 'coverage')}coverage: 0 not seen, to 1 seen as well as here")
    if display.kind == "normals":
        return wrap.format("normals: x, y, z of the scene from -1 to 1 are red, green, blue")
    if display.kind in ("dolp", "opacity"):
        return wrap.format(f"{picture(previews.as_rgb(ramp), display.kind)}{display.name}: 0 to 1")
    if display.kind == "deviation":
        return wrap.format("one standard deviation of what is predicted, mean over channels, five times as bright as the light")
    return ""


def _wheel() -> np.ndarray:
    """The hues of AoLP around a circle, twice, as angles of polarization are."""
    y, x = np.mgrid[-1:1:64j, -1:1:64j].astype(np.float32)
    angle, radius = np.arctan2(-y, x), np.hypot(x, y)
    stokes = np.stack([np.ones_like(x), radius * np.cos(2 * angle), radius * np.sin(2 * angle)], -1)
    return np.where((radius <= 1.0)[..., None], previews.to_uint8(previews.preview_aolp(stokes)), 255).astype(np.uint8)


def _add_pixel_panel(viewer: Viewer, session: Session) -> None:
    gui = session.client.gui
    gui.add_markdown("Click the picture: spectrum, polarization, place and the training pixels that saw it.")
    shown = gui.add_html("")

    @session.client.scene.on_click()
    def _(event: Any) -> None:
        view = viewer.view_of(session)
        towards = view.camera_to_world[:3, :3].T @ np.asarray(event.ray_direction, dtype=np.float64)
        viewer.ask(_answer(viewer, view, towards / np.linalg.norm(towards), shown))


def _answer(viewer: Viewer, view: PosedCamera, direction: np.ndarray, shown: Any) -> Iterator[None]:
    answer = ask(viewer.field, view.camera_to_world, direction, viewer.scene)
    covered = None
    if answer.point is not None and answer.normal is not None:
        frames = [(viewer.field.pose_of(s.frame), s.frame.camera) for s in answer.sightings]
        covered = coverage_of_point(frames, view, answer.point, answer.normal)
    shown.content = answer_html(viewer.field, answer, None if viewer.scene is None else viewer.pixels_of, covered)
    yield


def _add_scene_panel(viewer: Viewer, session: Session) -> None:
    gui: Any = session.client.gui
    scene, field = viewer.scene, viewer.field
    stage = Stage(viewer, session)
    if scene is None:
        gui.add_markdown("The scene of this run is gone: no frames to show.")
    toggles: list[tuple[str, str, Callable[[bool], None]]] = [("Region of interest", "the ball that is learned", stage.show_region)]
    if scene is not None:
        toggles += [
            *((f"Cameras: {name}", "click one to stand there", _of_sensor(stage.show_cameras, name)) for name in scene.sensors),
            ("Poses as given", "before the fit corrected them, in grey", stage.show_given),
            ("Rig", "the sensors of the first view, by name", stage.show_rig),
        ]
        if stage.has_points:
            toggles.append(("Sparse points", "that lie with the scene", stage.show_points))
    if stage.mesh_file is not None:
        toggles.append(("Mesh", f"{stage.mesh_file.name} of the run", stage.show_mesh))
    for label, hint, show in toggles:
        box = gui.add_checkbox(label, False, hint=hint)

        @box.on_update
        def _(event: Any, show: Callable[[bool], None] = show) -> None:
            show(event.target.value)
            session.objects = stage.visible
            session.show = True
            viewer.wake()

    if scene is None:
        return
    frames = {frame_name(frame): frame for frame in scene.frames if frame.sensor in field.sensors}
    if not frames:
        return
    chosen = gui.add_dropdown("Frame", list(frames))
    stand = gui.add_button("Stand there", hint="Moves the camera to where this frame was taken, and compares the frame with the field")
    pictures = gui.add_html("")

    def go(frame: Frame) -> None:
        viewer.stand_at(session, PosedCamera(frame.camera, field.pose_of(frame)))
        chosen.value = frame_name(frame)
        viewer.ask(_compare(viewer, frame, pictures))

    stage.on_camera = go
    stand.on_click(lambda _: go(frames[chosen.value]))


def _of_sensor(show: Callable[[str, bool], None], name: str) -> Callable[[bool], None]:
    return lambda on: show(name, on)


def _compare(viewer: Viewer, frame: Frame, shown: Any) -> Iterator[None]:
    """Frame, rendering through its lens and difference, one below the other."""
    assert viewer.scene is not None
    field, sensor = viewer.field, viewer.scene.sensors[frame.sensor]
    width = min(_FRAME_WIDTH, frame.camera.width)
    view = PosedCamera(resized(frame.camera, width), field.pose_of(frame))
    display = find_display(field, frame.sensor)
    seen = look(field, view, [display])
    assert seen is not None
    ours = linear_of(field, display, seen, viewer.colours)
    measured = viewer.linear_of_frame(frame)
    measured = cv2.resize(measured, ours.shape[1::-1], interpolation=cv2.INTER_AREA).reshape(ours.shape)
    exposure = previews.exposure_of(measured)
    error = float(np.sqrt(np.mean((measured - ours) ** 2)))
    rows = [
        (f"{sensor.name}, view {frame.view}: frame", previews.to_uint8(previews.tone_map(measured, exposure))),
        ("rendering", previews.to_uint8(previews.tone_map(ours, exposure))),
        (f"difference × 5, rms {error:.4f} of full scale", previews.to_uint8(5.0 * np.abs(measured - ours).mean(-1))),
    ]
    figure = (
        '<figure style="margin:.4em .9em">'
        '<img alt="{text}" src="data:image/png;base64,{data}" style="width:100%;image-rendering:pixelated">'
        '<figcaption style="font-size:.8em">{text}</figcaption></figure>'
    )
    shown.content = "".join(figure.format(text=text, data=base64.b64encode(previews.encode_png(image)).decode()) for text, image in rows)
    yield
