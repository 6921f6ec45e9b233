"""The viewer as people see it, in a headless Chromium."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from analytic import AnalyticField, scene_of, sphere
from browsers import chromium, errors_of
from test_viewer import free_port
from typer.testing import CliRunner

from mmsynth.cli import app
from mmsynth.operations.views.load import load_views
from mmsynth.sensors.camera import Camera
from mmsynth.viewer.open import open_viewer
from mmsynth.viewer.viewer import Viewer

pytest.importorskip("viser")
pytestmark = [pytest.mark.browser, pytest.mark.slow]
SIZE = {"width": 1000, "height": 560}
HERE = (400, 330)  # on the canvas, beside the panels


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[Viewer]:
    """Of a sphere in closed form, served by a thread."""
    field = AnalyticField(sphere(), mirrored=0.2)
    made = open_viewer(field, scene_of(field, tmp_path / "scene"), tmp_path / "run", port=free_port(), live=True)  # small pictures
    going = threading.Event()

    def serve() -> None:
        while not going.is_set():
            if not made.work(0.2):
                made.wait(0.05)

    thread = threading.Thread(target=serve)
    thread.start()
    yield made
    going.set()
    thread.join()
    made.close()


def opened(browser: Any, viewer: Viewer) -> Any:
    """A page whose picture has come to rest."""
    page = browser.new_page(viewport=SIZE)
    page.errors = errors_of(page)
    before = len(viewer.sessions)
    page.goto(viewer.url)
    page.wait_for_selector("canvas")
    until(lambda: len(viewer.sessions) > before, "a session")
    rest(page, viewer)
    return page


def until(met: Callable[[], Any], what: str, seconds: float = 60.0) -> Any:
    end = time.monotonic() + seconds
    while not (found := met()):
        assert time.monotonic() < end, f"{what}: not within {seconds:g} s"
        time.sleep(0.05)
    return found


def rest(page: Any, viewer: Viewer) -> None:
    sessions = lambda: list(viewer.sessions.values())
    until(lambda: sessions() and all(s.looking.finished and s.looking.seen is not None and not s.show for s in sessions()), "a picture")
    page.wait_for_timeout(600)
    last = shot(page)
    for _ in range(100):  # until the browser has drawn it
        page.wait_for_timeout(300)
        last, previous = shot(page), last
        if np.array_equal(last, previous):
            return
    raise AssertionError("the picture never comes to rest")


def shot(page: Any) -> np.ndarray:
    """(H, W, 3) of what lies left of the panels."""
    image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    return image[160:, :600].astype(float)


def settled(page: Any) -> None:
    """Of what panels send within 50 ms the client keeps the last alone (viser's throttle): its own timers must have run."""
    page.evaluate("() => new Promise(done => setTimeout(done, 200))")


def drag(page: Any, right: int, down: int = 0) -> None:
    page.mouse.move(*HERE)
    page.mouse.down()
    page.mouse.move(HERE[0] + right, HERE[1] + down, steps=5)
    page.mouse.up()


def press(page: Any, name: str) -> None:
    page.get_by_role("button", name=name).click()
    settled(page)


def fill(page: Any, label: str, value: str) -> None:
    page.get_by_label(label).fill(value)
    settled(page)


def choose(page: Any, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).last.click()
    page.get_by_role("option", name=option, exact=True).click()
    settled(page)


def test_a_drag_and_a_choice_change_the_picture(browser: Any, viewer: Viewer) -> None:
    page = opened(browser, viewer)
    first = shot(page)
    assert first.std() > 5.0  # the sphere's shade
    drag(page, 80, 20)
    page.wait_for_timeout(300)
    rest(page, viewer)
    turned = shot(page)
    assert np.abs(turned - first).mean() > 1.0
    choose(page, "Show", "normals")
    rest(page, viewer)
    coloured = shot(page)
    assert np.abs(coloured - turned).mean() > 10.0 and coloured[-1, 0].max() == 0.0  # nothing is met there
    assert page.get_by_text("normals: x, y, z of the scene").is_visible()
    assert not page.errors
    page.close()


def test_a_click_shows_the_light_that_the_field_renders_there(browser: Any, viewer: Viewer) -> None:
    page = opened(browser, viewer)
    page.get_by_role("tab", name="Pixel").click()
    page.mouse.click(460, 310)
    page.wait_for_selector(".mmsynth-pixel")
    texts = lambda cells: page.locator(f".mmsynth-pixel td{cells}").all_inner_texts()
    told = dict(zip(texts(":first-child"), texts(".value"), strict=True))
    (session,) = viewer.sessions.values()
    whole = viewer.view_of(session).camera
    assert (whole.width, whole.height) == (SIZE["width"], SIZE["height"])
    one = Camera(1, 1, whole.fx, whole.fy, whole.cx - 460.0, whole.cy - 310.0)  # that pixel alone
    seen = viewer.field.render(one, viewer.view_of(session).camera_to_world)
    for i, label in enumerate(("R", "G", "B")):
        assert float(told[f"rgb {label}"]) == pytest.approx(float(seen.channels["rgb"][0, 0, i]), abs=1e-3)
    for i, label in enumerate(viewer.field.sensors["ms"].channels):
        assert float(told[f"ms {label}"]) == pytest.approx(float(seen.channels["ms"][0, 0, i]), abs=1e-3)
    assert float(told["pol S0"]) == pytest.approx(float(seen.stokes["pol"][0, 0, 0]), abs=1e-3)
    assert page.locator(".mmsynth-pixel svg").count() == 1 and page.locator(".mmsynth-pixel img").count() >= 3
    assert not page.errors
    page.close()


def test_standing_at_a_frame_shows_it_beside_its_rendering(browser: Any, viewer: Viewer) -> None:
    page = opened(browser, viewer)
    page.get_by_role("tab", name="Scene").click()
    for name in ("Cameras: rgb", "Region of interest"):
        page.get_by_role("checkbox", name=name, exact=True).click()
        settled(page)
    choose(page, "Frame", "rgb 0002")
    press(page, "Stand there")
    page.get_by_text("rgb, view 2: frame").wait_for()
    (session,) = viewer.sessions.values()
    assert viewer.scene is not None
    wanted = viewer.scene.frames_of("rgb", (2,))[0].camera_to_world
    until(lambda: np.abs(viewer.view_of(session).camera_to_world - wanted).max() < 1e-3, "the camera's move")
    rms = re.search(r"rms ([\d.]+) of full scale", page.get_by_text("difference").inner_text())
    assert rms is not None and float(rms[1]) < 0.05  # of the field that recorded it, but for the demosaicking
    assert not page.errors
    page.close()


def test_a_path_is_saved_flown_and_filmed_within_the_run(browser: Any, viewer: Viewer) -> None:
    page = opened(browser, viewer)
    page.get_by_role("tab", name="Path").click()
    press(page, "Save poses")
    page.get_by_text("it takes two key poses").wait_for()
    press(page, "Add key pose here")
    page.get_by_text("1 key pose.").wait_for()
    drag(page, 60)
    rest(page, viewer)
    press(page, "Add key pose here")
    page.get_by_text("2 key poses.").wait_for()
    page.locator('input[value="path"]').fill("../outside")
    settled(page)
    press(page, "Save poses")
    page.get_by_text("expected letters, digits").wait_for()
    page.locator('input[value="../outside"]').fill("mine")
    settled(page)
    fill(page, "Seconds", "0.5")
    fill(page, "Width [px]", "48")
    press(page, "Save poses")
    path = viewer.folder / "paths" / "mine.json"
    until(path.is_file, "the poses")
    views = load_views(path, viewer.field)
    assert len(views) == 12 and {view.camera.width for view in views} == {48}
    (session,) = viewer.sessions.values()
    np.testing.assert_allclose(views[-1].camera_to_world, viewer.view_of(session).camera_to_world, atol=1e-6)
    press(page, "Save video")
    film = viewer.folder / "videos" / "mine.mp4"
    until(film.is_file, "the video")
    assert cv2.VideoCapture(str(film)).get(cv2.CAP_PROP_FRAME_COUNT) == 12
    fill(page, "Seconds", "5")  # time to be seen on the way
    page.get_by_role("button", name="Fly along it").click()
    until(lambda: np.abs(viewer.view_of(session).camera_to_world - views[0].camera_to_world).max() < 0.3, "the way back")
    assert {p.name for p in viewer.folder.rglob("*") if p.is_file()} == {"mine.json", "mine.mp4"} and not page.errors
    page.close()


def test_two_browsers_see_their_own_cameras(browser: Any, viewer: Viewer) -> None:
    first, second = opened(browser, viewer), opened(browser, viewer)
    until(lambda: len(viewer.sessions) == 2, "both")
    before, still = shot(first), shot(second)
    drag(first, 80)
    rest(first, viewer)
    assert np.abs(shot(first) - before).mean() > 1.0
    assert np.abs(shot(second) - still).mean() < 0.5
    first.close()
    until(lambda: len(viewer.sessions) == 1, "the other alone")
    second.close()


@pytest.mark.usefixtures("decided_by_few_rays")
def test_from_a_run_to_a_dataset_on_the_command_line(browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The viewer is a process of its own."""
    monkeypatch.chdir(tmp_path)
    call = lambda *args: CliRunner().invoke(app, args)
    assert call("fit", "example", "--steps", "20", "--run", "run").exit_code == 0
    port = free_port()
    command = [sys.executable, "-m", "mmsynth", "view", "--run", "run", "--port", str(port)]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stderr is not None
            told = process.stdout.readline()
            assert f"http://127.0.0.1:{port} (this machine alone can see it" in told
            page = browser.new_page(viewport=SIZE)
            errors = errors_of(page)
            page.goto(f"http://127.0.0.1:{port}")
            page.get_by_role("tab", name="Path").click(timeout=60_000)
            press(page, "Add key pose here")
            page.get_by_text("1 key pose.").wait_for()
            drag(page, 60)
            page.wait_for_timeout(500)
            press(page, "Add key pose here")
            fill(page, "Pictures a second", "1")
            fill(page, "Seconds", "3")
            fill(page, "Width [px]", "32")
            press(page, "Save poses")
            poses = tmp_path / "run" / "paths" / "path.json"
            until(poses.is_file, "the poses")
            page.close()
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=60)
            assert process.returncode == 130 and said.splitlines()[-1:] == ["interrupted"] and not errors
        finally:  # a test that failed would wait for it
            process.kill()
    made = call("generate-dataset", "--run", "run", "--poses", str(poses), "--out", "data", "--json")
    assert made.exit_code == 0 and json.loads(made.stdout)["views"] == 3, made.stderr
    filmed = call("video", "--run", "run", "--poses", str(poses), "--show", "rgb,ms:5,aolp", "--json")
    assert json.loads(filmed.stdout) == {"out": "run/videos/path.mp4", "pictures": 3, "show": ["rgb", "ms:5", "pol:aolp"]}, filmed.stderr
