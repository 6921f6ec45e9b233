"""The reader of NeRF-synthetic scenes, whose split is that of the files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import OPENCV_TO_OPENGL, ring

from mmsynth.errors import InputError
from mmsynth.scene.images import load_frame
from mmsynth.scene.load import load_scene
from mmsynth.sensors.camera import unproject

SIZE = (20, 12)  # width, height


def picture(file: Path, size: tuple[int, int] = SIZE, channels: int = 4) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), np.random.default_rng(0).integers(0, 256, (size[1], size[0], channels), np.uint8))


def write(root: Path, edit: Callable[[dict[str, Any]], None] = lambda meta: None, suffix: str = "png", **counts: int) -> Path:
    """Splits by name with their counts of frames; ``edit`` changes each split's metadata."""
    for split, count in (counts or {"train": 4, "val": 2, "test": 3}).items():
        frames = []
        for index, pose in enumerate(ring(count, radius=4.0)):
            picture(root / split / f"r_{index}.{suffix}")
            frames.append({"file_path": f"./{split}/r_{index}", "rotation": 0.1, "transform_matrix": (pose @ OPENCV_TO_OPENGL).tolist()})
        meta: dict[str, Any] = {"camera_angle_x": 0.6911112, "frames": frames}
        edit(meta)
        (root / f"transforms_{split}.json").write_text(json.dumps(meta))
    return root


def test_the_split_is_that_of_the_files(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path))
    assert scene.format == "Blender" and scene.split.train == (0, 1, 2, 3) and scene.split.test == (6, 7, 8)
    assert scene.split.source == "transforms_test.json" and any("2 frames of transforms_val.json" in text for text in scene.problems)
    assert [frame.path.parent.name for frame in scene.frames] == ["train"] * 4 + ["test"] * 3
    for frame, pose in zip(scene.frames, [*ring(4, 4.0), *ring(3, 4.0)], strict=True):
        np.testing.assert_allclose(frame.camera_to_world, pose, atol=1e-9)


def test_val_tests_where_there_is_no_test(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path, train=4, val=2))
    assert (scene.split.train, scene.split.test, scene.split.source) == ((0, 1, 2, 3), (4, 5), "transforms_val.json")
    assert load_scene(write(tmp_path / "alone", train=4)).split.source == "the last view"


def test_the_angle_is_that_between_the_borders(tmp_path: Path) -> None:
    camera = load_scene(write(tmp_path)).frames[0].camera
    borders = unproject(np.array([[-0.5, 5.5], [19.5, 5.5]]), camera)[0]
    assert np.arccos(borders[0] @ borders[1]) == pytest.approx(0.6911112, abs=1e-9)
    assert camera.fx == camera.fy and (camera.cx, camera.cy) == (9.5, 5.5)


def test_alpha_stays_alpha(tmp_path: Path) -> None:
    scene = load_scene(write(tmp_path))
    pixels, alpha = load_frame(scene.sensors["rgb"], scene.frames[0])
    assert pixels.shape == (12, 20, 3) and alpha is not None and scene.black_background and scene.masks == "off"


@pytest.mark.parametrize("stated", [(40.0, 24.0), (39.0, 24.0), (800, 800), (40.5, 24.0)])
def test_stated_size_need_not_be_that_of_the_files(tmp_path: Path, stated: tuple[float, float]) -> None:
    """Reduced as a whole, to the pixel; and a size that has nothing to do with the files beside an angle."""
    scene = load_scene(write(tmp_path, lambda meta: meta.update(w=stated[0], h=stated[1])))
    camera = scene.frames[0].camera
    assert (camera.width, camera.height) == SIZE
    assert camera.fx == pytest.approx(10 / np.tan(0.6911112 / 2), rel=1e-9)  # the angle is of the width, whatever it is
    assert any("their cameras are scaled" in text for text in scene.problems) == (stated in ((40.0, 24.0), (39.0, 24.0)))


def test_pixels_of_another_size_without_a_ratio_are_refused(tmp_path: Path) -> None:
    root = write(tmp_path, lambda meta: meta.update(w=800, h=800, fl_x=1000.0, fl_y=1000.0, cx=400.0, cy=400.0))
    with pytest.raises(InputError, match=r"r_0\.png: the picture is 20x12 pixels, expected 800x800 .*by one ratio"):
        load_scene(root)


def test_what_is_not_listed_is_not_read(tmp_path: Path) -> None:
    root = write(tmp_path)
    for name in ("train/r_0_normal_0001.png", "train/r_0_depth_0001.png", "train/.DS_Store", "train/000.png"):
        (root / name).write_bytes(b"no picture")
    (root / "test" / "r_1.png").unlink()
    scene = load_scene(root)
    assert len(scene.frames) == 6 and any("1 of 7 frames have no image file" in text for text in scene.problems)
    assert scene.split.test == (6, 8)


@pytest.mark.parametrize("suffix", ["webp", "PNG", "JPG"])
def test_suffix_is_that_of_the_file(tmp_path: Path, suffix: str) -> None:
    scene = load_scene(write(tmp_path, suffix=suffix))
    assert scene.frames[0].path.name == f"r_0.{suffix}" and len(scene.frames) == 7


def test_no_pictures_and_no_frames(tmp_path: Path) -> None:
    write(tmp_path, lambda meta: [frame.update(file_path="elsewhere/" + frame["file_path"]) for frame in meta["frames"]])
    with pytest.raises(InputError, match=r"none of the 7 frames .*--images FOLDER"):
        load_scene(tmp_path)
    (tmp_path / "transforms_train.json").write_text("[]")
    with pytest.raises(InputError, match=r"transforms_train\.json: a JSON list"):
        load_scene(tmp_path)
