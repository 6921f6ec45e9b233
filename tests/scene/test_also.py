"""More sensors in a layout made for one, and scene.toml."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import HEIGHT, WIDTH, ring

from mmsynth.errors import InputError
from mmsynth.scene.images import load_frame
from mmsynth.scene.layouts.calibration import RigSensor, write_calibration
from mmsynth.scene.load import load_again, load_scene
from mmsynth.scene.serialisation import source_to_json
from mmsynth.sensors.camera import Camera, project

Writer = Callable[..., Path]


def pictures(folder: Path, count: int = 4, size: tuple[int, int] = (WIDTH, HEIGHT), suffix: str = "webp") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for view in range(count):
        grey = np.random.default_rng(view).integers(0, 256, (size[1], size[0]), np.uint8)
        cv2.imwrite(str(folder / f"{view:04d}.{suffix}"), np.dstack([grey] * 3), [cv2.IMWRITE_WEBP_QUALITY, 101])
    return folder


def test_one_pose_and_one_camera_for_both(write_transforms: Writer) -> None:
    root = write_transforms()
    pictures(root / "nir")
    scene = load_scene(root, also={"infrared": "nir"})
    assert list(scene.sensors) == ["rgb", "nir"] and scene.sensors["nir"].channels == ("nir",)
    for one, other in zip(scene.frames_of("rgb"), scene.frames_of("nir"), strict=True):
        assert one.view == other.view and one.camera == other.camera and other.path.name == f"{one.view:04d}.webp"
        np.testing.assert_array_equal(one.camera_to_world, other.camera_to_world)
    pixels, alpha = load_frame(scene.sensors["nir"], scene.frames_of("nir")[2])
    assert alpha is None
    np.testing.assert_allclose(pixels[..., 0] * 255, np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH), np.uint8), atol=1e-4)
    assert list(load_scene(root, also={"nir": "nir"}, modalities=["nir"]).sensors) == ["nir"]


def test_other_size_scales_the_camera(write_transforms: Writer) -> None:
    root = write_transforms()
    pictures(root / "half", size=(WIDTH // 2, HEIGHT // 2))
    scene = load_scene(root, also={"nir": "half"})
    full, half = (scene.frames_of(name)[0] for name in ("rgb", "nir"))
    rays = np.array([[0.1, -0.2, 1.0], [0.3, 0.05, 1.0]])
    np.testing.assert_allclose((project(rays, full.camera) + 0.5) / 2 - 0.5, project(rays, half.camera), atol=1e-9)
    pictures(root / "odd", size=(WIDTH // 2, HEIGHT))
    with pytest.raises(InputError, match="by one ratio"):
        load_scene(root, also={"nir": "odd"})


@pytest.mark.parametrize("reference", ["rgb", "mono"])
def test_own_place_on_the_rig(write_transforms: Writer, reference: str) -> None:
    """pose = pose of the reference @ camera_to_reference; also where the calibration's reference is another sensor than the scene's."""
    root = write_transforms()
    pictures(root / "thermal", size=(30, 20))
    rgb, thermal = Camera(WIDTH, HEIGHT, 25.0, 26.0, 11.7, 8.4), Camera(30, 20, 40.0, 41.0, 15.0, 9.0, (0.1, 0.01, 0.0, 0.0))
    on_rig = ring(3)[1]
    rig = {"rgb": RigSensor(rgb, np.eye(4)), "thermal": RigSensor(thermal, on_rig)}
    if reference == "mono":
        moved = ring(5)[2]
        rig = {
            "mono": RigSensor(rgb, np.eye(4)),
            "thermal": RigSensor(thermal, moved @ on_rig),
            "rgb": RigSensor(rgb, moved),
        }
    write_calibration(root / "calibration.json", rig)
    scene = load_scene(root, also={"thermal": "thermal:calibration.json"})
    for one, other in zip(scene.frames_of("rgb"), scene.frames_of("thermal"), strict=True):
        np.testing.assert_allclose(other.camera_to_world, one.camera_to_world @ on_rig, atol=1e-9)
        np.testing.assert_array_equal(other.camera.coefficients, thermal.coefficients)
    assert any("in metres" in text for text in scene.problems)
    with pytest.raises(InputError, match="no sensor 'nir'"):
        load_scene(root, also={"nir": "thermal:calibration.json"})


def test_missing_pictures_and_wrong_folders(write_transforms: Writer) -> None:
    root = write_transforms()
    (pictures(root / "nir") / "0002.webp").unlink()
    assert any("nir: 1 of 4 frames of 'rgb' have no picture" in text for text in load_scene(root, also={"nir": "nir"}).problems)
    for also, said in (({"nir": "nowhere"}, "no such file or folder"), ({"rgb": "nir"}, "a sensor 'rgb' already")):
        with pytest.raises(InputError, match=said):
            load_scene(root, also=also)
    (root / "empty").mkdir()
    with pytest.raises(InputError, match="no picture in it is called as one of 'rgb', expected names such as 0000"):
        load_scene(root, also={"nir": "empty"})


def test_scene_toml_says_where_pictures_are(write_transforms: Writer) -> None:
    """Metadata that name pictures which are elsewhere, with another suffix: five lines."""
    root = write_transforms(edit=lambda meta: [frame.update(file_path="rgb/" + Path(frame["file_path"]).stem) for frame in meta["frames"]])
    with pytest.raises(InputError, match="has an image file"):
        load_scene(root)
    pictures(root / "cache" / "nir")
    (root / "scene.toml").write_text('layout = "nerfstudio"\nimages = "images"\n[also]\nnir = "cache/nir"\n')
    scene = load_scene(root)
    assert list(scene.sensors) == ["rgb", "nir"] and len(scene.frames) == 8
    assert load_scene(root / "scene.toml").sensors.keys() == scene.sensors.keys()
    assert list(load_scene(root, also={"mono": "cache/nir"}).sensors) == ["rgb", "nir", "mono"]  # in addition


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('image = "images"', r"scene\.toml: image: Extra inputs"),
        ("images = 3", r"scene\.toml: images: Input should be a valid string"),
        ("layout = ", r"scene\.toml: not valid TOML"),
        ('layout = "foo"', r"scene\.toml: layout 'foo': no such layout, expected one of MMS-DATA"),
        ('images = "foo"', "no such file or folder"),
    ],
)
def test_bad_scene_toml(write_transforms: Writer, text: str, said: str) -> None:
    root = write_transforms()
    (root / "scene.toml").write_text(text)
    with pytest.raises(InputError, match=said):
        load_scene(root)


def test_two_names_for_one_picture_are_refused(write_transforms: Writer) -> None:
    root = write_transforms(edit=lambda meta: [frame.update(file_path=f"{i}/0000.png") for i, frame in enumerate(meta["frames"])])
    with pytest.raises(InputError, match=r"0000\.png: stands for '0/0000\.png' and '1/0000\.png'"):
        load_scene(root, images="images")


def test_a_manifest_says_all_that_it_takes_to_read_again(write_transforms: Writer, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write_transforms(edit=lambda meta: [frame.update(file_path="x/" + frame["file_path"]) for frame in meta["frames"]])
    pictures(root / "nir")
    monkeypatch.chdir(root.parent)
    scene = load_scene(root.name, images="images", also={"nir": "nir"}, layout="NerfStudio")
    stated = json.loads(json.dumps(source_to_json(scene)))
    files = [frame.path.resolve() for frame in scene.frames]
    monkeypatch.chdir("/")
    again = load_again(stated)
    assert source_to_json(again) == stated and [frame.path for frame in again.frames] == files
    assert list(load_again(stated, modalities=["nir"]).sensors) == ["nir"]
