"""A path as a video: what OpenCV reads back is what was shown."""

from __future__ import annotations

import resource
from pathlib import Path

import cv2
import numpy as np
import pytest
from analytic import AnalyticField, ring_pose, sphere

from mmsynth.errors import InputError
from mmsynth.operations.views.displays import exposures_of, find_display, look, picture
from mmsynth.operations.views.video import video_steps
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera

FIELD = AnalyticField(sphere())
CAMERA = Camera(64, 47, 60.0, 60.0, 31.5, 23.0)
VIEWS = [PosedCamera(CAMERA, ring_pose(i, 12), f"{i:04d}") for i in range(3)]


def frames_of(path: Path) -> list[np.ndarray]:
    reader, out = cv2.VideoCapture(str(path)), []
    while (read := reader.read())[0]:
        out.append(read[1][..., ::-1])
    return out


def test_pictures_and_rate_are_those_of_the_path(tmp_path: Path) -> None:
    path, show = tmp_path / "new" / "a.mp4", [find_display(FIELD, "rgb")]
    assert list(video_steps(FIELD, VIEWS, show, path, 12.0)) == [(1, 3), (2, 3), (3, 3)]
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FPS) == 12.0
    found = frames_of(path)
    assert len(found) == 3 and found[0].shape == (48, 64, 3)  # even, for the codec
    seen = look(FIELD, VIEWS[0], show)
    assert seen is not None
    expected = picture(FIELD, show[0], seen, exposures_of(FIELD, show, seen)["rgb"])
    assert np.abs(found[0][:46, :63].astype(float) - expected[:46, :63]).mean() < 8.0  # of 255, after compression
    assert [p.name for p in path.parent.iterdir()] == ["a.mp4"]


def test_several_stand_beside_each_other_with_their_names(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    for _ in video_steps(FIELD, VIEWS[:1], [find_display(FIELD, name) for name in ("rgb", "depth", "aolp")], path):
        pass
    (frame,) = frames_of(path)
    assert frame.shape == (66, 192, 3)
    assert all(frame[:18, start : start + 64].max() > 100 for start in (0, 64, 128))  # the names


def test_one_that_is_given_up_leaves_nothing(tmp_path: Path) -> None:
    steps = video_steps(FIELD, VIEWS, [find_display(FIELD, "rgb")], tmp_path / "a.mp4")
    next(steps)
    steps.close()  # type: ignore[attr-defined]
    assert not list(tmp_path.iterdir())


def test_a_disk_that_fills_up_is_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The kernel refuses to let the file grow, as a full disk would; OpenCV says nothing of it to its caller."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(InputError, match=r"a\.mp4: could not be written \(it is cut off: the disk may be full\)"):
            list(video_steps(FIELD, VIEWS, [find_display(FIELD, "rgb")], tmp_path / "a.mp4"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir()) and not capfd.readouterr().err


def test_what_cannot_be_filmed_is_said(tmp_path: Path) -> None:
    show = [find_display(FIELD, "rgb")]
    other = PosedCamera(Camera(32, 24, 30.0, 30.0, 15.5, 11.5), ring_pose(0, 4))
    for views, path, said in (
        ([], tmp_path / "a.mp4", "no poses"),
        ([*VIEWS, other], tmp_path / "a.mp4", "several sizes"),
        (VIEWS, tmp_path / "a.avi", "ends in .mp4"),
    ):
        with pytest.raises(InputError, match=said):
            next(video_steps(FIELD, views, show, path))
