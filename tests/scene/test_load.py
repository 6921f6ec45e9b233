"""load_scene: picking the reader, refusing what cannot be learned from; describe and its text."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import OPENCV_TO_OPENGL, look_at

from mmsynth.errors import InputError
from mmsynth.scene.info import describe_scene, render_text
from mmsynth.scene.load import load_again, load_scene
from mmsynth.scene.serialisation import source_to_json

Writer = Callable[..., Path]


def test_picks_the_reader(write_mmsdata: Writer) -> None:
    root = write_mmsdata()
    assert load_scene(root).format == load_scene(str(root / "meta_data.json")).format == "MMS-DATA"


def test_picks_nerfstudio(write_transforms: Writer) -> None:
    root = write_transforms()
    assert load_scene(root).format == load_scene(root / "transforms.json").format == "nerfstudio"


def test_of_two_layouts_the_one_with_more_pictures(write_transforms: Writer) -> None:
    root = write_transforms(count=5)
    meta = json.loads((root / "transforms.json").read_text())
    (root / "transforms_train.json").write_text(json.dumps({**meta, "frames": meta["frames"][:4]}))
    scene = load_scene(root)
    assert scene.format == "nerfstudio"
    assert scene.problems == ("read as nerfstudio, 5 pictures; the folder also holds Blender with 4: --layout NAME decides.",)
    assert load_scene(root, layout="blender").format == "Blender" and load_scene(root, layout="blender").problems == ()
    (root / "transforms.json").write_text("{}")
    scene = load_scene(root)
    assert scene.format == "Blender" and "nerfstudio, which cannot be read" in scene.problems[0]
    for layout, said in (("COLMAP", r"no sparse/0 in it, expected the layout COLMAP"), ("foo", "no such layout, expected one of MMS-DATA")):
        with pytest.raises(InputError, match=said):
            load_scene(root, layout=layout)
    with pytest.raises(InputError, match="a file of the layout nerfstudio, expected the folder for the layout Blender"):
        load_scene(root / "transforms_train.json", layout="blender")


def test_a_scene_in_one_file_is_read_again_from_it(write_transforms: Writer) -> None:
    """Not from the folder's transforms.json."""
    root = write_transforms(count=5)
    meta = json.loads((root / "transforms.json").read_text())
    (root / "less.json").write_text(json.dumps({**meta, "frames": meta["frames"][:4]}))
    again = load_again(source_to_json(load_scene(root / "less.json")))
    assert len(again.frames) == 4


def test_pictures_of_another_size_have_their_cameras_scaled(write_transforms: Writer) -> None:
    root = write_transforms()
    full = load_scene(root).frames[0].camera
    for file in (root / "images").iterdir():
        cv2.imwrite(str(file), np.zeros((9, 12, 3), np.uint8))
    scene = load_scene(root)
    assert scene.frames[0].camera == dataclasses.replace(
        full, width=12, height=9, fx=full.fx / 2, fy=full.fy / 2, cx=(full.cx + 0.5) / 2 - 0.5, cy=(full.cy + 0.5) / 2 - 0.5
    )
    assert any("4 pictures have 0.5 times the size" in text for text in scene.problems)


def test_missing_and_unknown_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"not a scene, expected meta_data\.json"):
        load_scene(tmp_path)
    (tmp_path / "calibration.json").write_text("{}")
    with pytest.raises(InputError, match="no camera poses"):
        load_scene(tmp_path)
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(InputError, match="not a scene"):
        load_scene(tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("files", "says"),
    [
        (["sparse/0/cameras.bin", "sparse/0/points3D.bin"], r"sparse/0: a COLMAP model's cameras.bin without images.bin, expected both"),
        (["sparse/images.txt"], r"sparse: a COLMAP model's images.txt without cameras.txt"),
        (["sparse/0/cameras.bin", "sparse/0/images.txt"], r"cameras.bin without images.bin"),
    ],
)
def test_half_a_colmap_model(files: list[str], says: str, tmp_path: Path) -> None:
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_bytes(b"")
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)


def test_modalities_by_name_or_alias(write_mmsdata: Writer) -> None:
    root = write_mmsdata()
    assert list(load_scene(root, modalities=["infrared"]).sensors) == list(load_scene(root, modalities=["NIR"]).sensors) == ["nir"]
    with pytest.raises(InputError, match="no modality 'thermal' in this scene, expected one of rgb, nir"):
        load_scene(root, modalities=["rgb", "thermal"])


def test_broken_json_is_located(write_mmsdata: Writer) -> None:
    root = write_mmsdata()
    (root / "meta_data.json").write_text('{"raw": true,\n "modalities": }')
    with pytest.raises(InputError, match=r"meta_data\.json: not valid JSON at line 2, column 16"):
        load_scene(root)


def test_scene_outside_the_region_is_refused(write_mmsdata: Writer) -> None:
    def away(meta: dict[str, Any]) -> None:
        for entry in meta["modalities"].values():
            for frame in entry["frames"]:
                position = np.array(frame["camtoworld"])[:, 3]
                frame["camtoworld"] = (look_at(position, 2 * position) @ OPENCV_TO_OPENGL)[:3].tolist()

    with pytest.raises(InputError, match="do not see the region of interest"):
        load_scene(write_mmsdata(edit=away))


def test_frames_that_look_elsewhere_are_a_problem(write_mmsdata: Writer) -> None:
    def away(meta: dict[str, Any]) -> None:
        frame = meta["modalities"]["infrared"]["frames"][1]
        position = np.array(frame["camtoworld"])[:, 3]
        frame["camtoworld"] = (look_at(position, 2 * position) @ OPENCV_TO_OPENGL)[:3].tolist()

    problems = load_scene(write_mmsdata(edit=away)).problems
    assert problems == ("1 of 8 frames do not see the region of interest, the first is nir view 1.",)


def test_region_smaller_than_a_pixel_is_still_seen(write_mmsdata: Writer) -> None:
    assert load_scene(write_mmsdata(edit=lambda meta: meta["scene_box"].update(radius=1e-6))).problems == ()


def test_too_few_training_frames(write_transforms: Writer) -> None:
    with pytest.raises(InputError, match=r"1 frames to train on \(2 in all\), expected at least 2"):
        load_scene(write_transforms(count=2))


def test_describe_is_json_and_text(write_mmsdata: Writer) -> None:
    root = write_mmsdata(views=range(10))
    (root / "modalities" / "rgb" / "0001.png").unlink()
    description = describe_scene(load_scene(root))
    assert json.loads(json.dumps(description, allow_nan=False)) == description
    rgb = description["sensors"]["rgb"]
    assert (rgb["frames"], rgb["train"], rgb["test"], rgb["size"], rgb["bits"]) == (9, 8, 1, [24, 18], 16)
    assert 0.4 < rgb["mean"] < 0.6 and rgb["invalid_lens_pixels"] == 0
    text = render_text(description)
    assert "mosaic 1 2 / 0 1" in text and "rgb: 1 of 10 frames have no image file" in text


def test_describe_lists_damaged_files_once(write_mmsdata: Writer) -> None:
    root = write_mmsdata(views=range(6))
    path = root / "modalities" / "infrared" / "0003.png"
    path.write_bytes(path.read_bytes()[:-20])
    problems = describe_scene(load_scene(root))["problems"]
    assert len(problems) == 1 and "0003.png: truncated PNG" in problems[0]


def test_describe_counts_pixels_without_a_ray(write_mmsdata: Writer) -> None:
    def fold(meta: dict[str, Any]) -> None:
        meta["modalities"]["rgb"]["distortion_params"] = [-1.5, 0, 0, 0, 0, 0]

    description = describe_scene(load_scene(write_mmsdata(edit=fold)))
    rgb = description["sensors"]["rgb"]
    assert 0 < rgb["invalid_lens_pixels"] < 24 * 18 and rgb["round_trip_px"] < 1e-3 and rgb["lens"] == "brown_conrady"
    (problem,) = description["problems"]
    assert problem.startswith("rgb: the lens model has no ray for about")
    text = render_text(description)
    assert f"{rgb['invalid_lens_pixels']} pixels" in text and "rays come back to their pixels within" in text


def test_rays_that_do_not_come_back_are_a_problem(write_mmsdata: Writer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mmsynth.scene.load.round_trip_error", lambda camera, pixels: (0.25, 0.0))
    problems = load_scene(write_mmsdata()).problems
    assert "rgb: rays come back 0.2 pixels from where they began." in problems and len(problems) == 2


def test_describe_suspects_right_aligned_data(write_mmsdata: Writer) -> None:
    root = write_mmsdata()
    for view in range(4):
        codes = np.random.default_rng(view).integers(0, 4096, (18, 24), np.uint16)
        cv2.imwrite(str(root / "modalities" / "infrared" / f"{view:04d}.png"), codes)
    assert any("not left-aligned" in problem for problem in describe_scene(load_scene(root))["problems"])
