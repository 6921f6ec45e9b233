"""Masks: what is read as foreground, and which file belongs to which frame."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import HEIGHT, WIDTH

from mmsynth.errors import InputError
from mmsynth.scene.info import describe_scene, render_text
from mmsynth.scene.load import load_scene
from mmsynth.scene.masks import read_mask, use_masks
from mmsynth.scene.scene import Scene

INSIDE = np.zeros((HEIGHT, WIDTH), np.uint8)
INSIDE[4:12, 6:16] = 1


def _write(path: Path, mask: np.ndarray = INSIDE) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), mask)
    return path


def _having(scene: Scene) -> dict[tuple[str, int], str]:
    return {(frame.sensor, frame.view): frame.mask.name for frame in scene.frames if frame.mask is not None}


@pytest.mark.parametrize(
    "picture",
    [
        INSIDE,
        INSIDE.astype(np.uint16) * 65535,
        np.stack([0 * INSIDE, INSIDE, 0 * INSIDE], -1),
        np.stack([255 * INSIDE] * 3 + [255 + 0 * INSIDE], -1),  # opaque everywhere
        np.stack([255 + 0 * INSIDE] * 3 + [255 * INSIDE], -1),  # cut out of white
    ],
    ids=["one", "16 bit", "green", "RGBA", "cut out"],
)
def test_foreground_is_what_is_not_zero_and_not_transparent(
    picture: np.ndarray, write_mmsdata: Callable[..., Path], tmp_path: Path
) -> None:
    scene = use_masks(load_scene(write_mmsdata()), None, _write(tmp_path / "some/rgb/0002.png", picture).parents[1])
    (frame,) = scene.frames_of("rgb", (2,))
    found = read_mask(frame)
    assert found is not None and found.dtype == bool
    np.testing.assert_array_equal(found, INSIDE > 0)
    assert read_mask(scene.frames_of("rgb", (1,))[0]) is None


@pytest.mark.parametrize("level", ["", "masks", "masks/scenes", "masks/scenes/scene", "masks/scenes/scene/modalities"])
@pytest.mark.parametrize("name", ["{:04d}.png", "scene_{:d}_mask.png", "cam3_{:05d}.png", "{:d}_05.png"])
def test_the_archive_of_mms_data_is_understood_at_any_level(
    level: str, name: str, write_mmsdata: Callable[..., Path], tmp_path: Path
) -> None:
    scene = load_scene(write_mmsdata(range(3, 9)))
    archive = tmp_path / "archive"
    for other in ("scene", "bouquet"):
        for modality in ("infrared", "rgb", "polarization"):
            for view in range(10):
                _write(archive / "masks/scenes" / other / "modalities" / modality / name.format(view))
    masked = use_masks(scene, None, archive / level)
    assert masked.masks == "off" and masked.mask_folder == archive / level
    assert _having(masked) == {(sensor, view): name.format(view) for sensor in ("rgb", "nir") for view in range(3, 9)}
    for frame in masked.frames:
        assert frame.mask is not None and frame.mask.parent == archive / "masks/scenes/scene/modalities" / frame.source_name


def test_the_folder_of_one_modality_is_for_that_one(write_mmsdata: Callable[..., Path], tmp_path: Path) -> None:
    folder = _write(tmp_path / "archive/masks/infrared/mask_01.png").parent
    masked = use_masks(load_scene(write_mmsdata()), "ignore", folder)
    assert masked.masks == "ignore" and _having(masked) == {("nir", 1): "mask_01.png"}
    assert f"{folder}: no mask for 4 of 4 frames of rgb." in masked.problems
    assert f"{folder}: no mask for 3 of 4 frames of nir." in masked.problems


@pytest.mark.parametrize("name", ["{}.png", "{}.png.png"])
def test_other_layouts_go_by_the_names_of_pictures(name: str, write_transforms: Callable[..., Path], tmp_path: Path) -> None:
    scene = load_scene(write_transforms())
    for view in (0, 2):
        _write(tmp_path / "of_it" / name.format(f"{view:04d}"))
    _write(tmp_path / "of_it" / "1.png")  # an id alone says nothing here
    masked = use_masks(scene, None, tmp_path / "of_it")
    assert masked.masks == "ignore"  # as nerfstudio's masks
    assert _having(masked) == {("rgb", view): name.format(f"{view:04d}") for view in (0, 2)}


def test_one_mask_serves_the_sensors_that_see_the_same(write_mmsdata: Callable[..., Path], tmp_path: Path) -> None:
    """Both sensors of the scene stand at one place; then one moves away at one view."""

    def moved(meta: dict) -> None:  # type: ignore[type-arg]
        meta["modalities"]["infrared"]["frames"][1]["camtoworld"][0][3] += 0.1

    _write(tmp_path / "flat/0000.png")
    _write(tmp_path / "flat/0001.png")
    masked = use_masks(load_scene(write_mmsdata(edit=moved)), None, tmp_path / "flat")
    assert set(_having(masked)) == {("rgb", 0), ("nir", 0), ("rgb", 1)}


@pytest.mark.parametrize(("half", "masked"), [(False, {"rgb", "nir"}), (True, {"rgb"})], ids=["same camera", "half size"])
def test_a_sensor_beside_has_the_masks_of_the_pictures_that_it_matches(
    half: bool, masked: set[str], write_transforms: Callable[..., Path]
) -> None:
    def with_masks(meta: dict) -> None:  # type: ignore[type-arg]
        for frame in meta["frames"]:
            frame["mask_path"] = "mask.png"

    root = write_transforms(edit=with_masks)
    _write(root / "mask.png")
    for view in range(4):
        _write(root / f"nir/{view:04d}.png", np.full((HEIGHT, WIDTH), 40 + view, np.uint8)[:: 1 + half, :: 1 + half])
    scene = load_scene(root, also={"nir": "nir"})
    assert {frame.sensor for frame in scene.frames if frame.mask is not None} == masked


def test_masks_that_are_named_and_not_there_are_said(write_transforms: Callable[..., Path]) -> None:
    def with_masks(meta: dict) -> None:  # type: ignore[type-arg]
        for index, frame in enumerate(meta["frames"]):
            frame["mask_path"] = f"masks/{index}.png"

    root = write_transforms(edit=with_masks)
    _write(root / "masks/0.png")
    scene = load_scene(root)
    assert [frame.view for frame in scene.frames if frame.mask is not None] == [0]
    (said,) = [problem for problem in scene.problems if "mask" in problem]
    assert said.startswith("3 of 4 frames") and str(root / "masks/1.png") in said


def test_bad_masks_are_one_sentence(write_mmsdata: Callable[..., Path], tmp_path: Path) -> None:
    scene = load_scene(write_mmsdata())

    def said(folder: Path, read: bool = False) -> str:
        with pytest.raises(InputError) as refused:
            masked = use_masks(scene, None, folder)
            assert read
            read_mask(masked.frames_of("rgb", (0,))[0])
        text = str(refused.value)
        assert "\n" not in text and text.startswith(str(folder)) and text.endswith(".")
        return text

    assert "no such folder" in said(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    assert "none of its 0 pictures" in said(tmp_path / "empty")
    _write(tmp_path / "strangers/rgb/mask_77.png")
    assert "none of its 1 pictures is the mask of a frame" in said(tmp_path / "strangers")
    for other in ("aloe", "bouquet"):
        _write(tmp_path / "others/scenes" / other / "modalities/rgb/0000.png")
    assert "expected those of one scene" in said(tmp_path / "others")
    _write(tmp_path / "small/rgb/0000.png", INSIDE[:-1])
    assert f"the mask is {WIDTH}x{HEIGHT - 1} pixels, expected {WIDTH}x{HEIGHT}" in said(tmp_path / "small", read=True)
    torn = _write(tmp_path / "torn/rgb/0000.png")
    torn.write_bytes(torn.read_bytes()[:40])
    assert "truncated PNG" in said(tmp_path / "torn", read=True)


def test_info_tells_of_masks_and_of_what_is_wrong_with_them(write_mmsdata: Callable[..., Path], tmp_path: Path) -> None:
    scene = load_scene(write_mmsdata())
    for view in range(4):
        _write(tmp_path / f"given/rgb/{view}.png")
        _write(tmp_path / f"given/infrared/{view}.png", 0 * INSIDE)
    _write(tmp_path / "given/rgb/3.png", INSIDE[1:])
    about = describe_scene(use_masks(scene, "object", tmp_path / "given"))
    json.dumps(about, allow_nan=False)
    assert about["masks"] == "object" and about["sensors"]["rgb"]["masks"] == 4
    assert about["sensors"]["rgb"]["foreground_percent"] == pytest.approx(100 * INSIDE.mean())
    assert any("3.png: the mask is" in problem for problem in about["problems"])
    assert "nir: 4 masks were read and all are empty, expected pixels that are not zero." in about["problems"]
    assert f"4 with a mask (foreground: {100 * INSIDE.mean():.1f} % of the pixels)" in render_text(about)
    assert describe_scene(scene)["sensors"]["rgb"]["foreground_percent"] is None
