"""Scenes written in another layout and read back: by our own readers, and by pycolmap."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import trimesh
from conftest import HEIGHT, WIDTH, frame_values, ring
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mmsynth.cli import app
from mmsynth.errors import InputError
from mmsynth.field.design import Corrections, Design
from mmsynth.field.field import Field
from mmsynth.operations.export.export import export_scene
from mmsynth.operations.export.plans import LAYOUTS, ExportLayout
from mmsynth.scene.image_writers import write_npz, write_png, write_png16
from mmsynth.scene.images import SUFFIXES
from mmsynth.scene.load import load_scene, sparse_points
from mmsynth.scene.scene import Frame, Region, Scene, Sensor, Split
from mmsynth.sensors.camera import Camera, project

Writer = Callable[..., Path]
OURS: tuple[ExportLayout, ...] = ("mms-data", "nerfstudio", "colmap")


def files_of(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def same_scene(back: Scene, scene: Scene) -> None:
    """Sensors, split, region and pixels exactly, poses and intrinsics to 1e-9, and so where points are seen.

    A COLMAP model has no ids of views: there they count what it has.
    """
    if back.format == "COLMAP":
        ids = sorted({frame.view for frame in scene.frames})
        back = replace(
            back,
            frames=tuple(replace(frame, view=ids[frame.view]) for frame in back.frames),
            split=Split(tuple(ids[view] for view in back.split.train), tuple(ids[view] for view in back.split.test), ""),
        )
    assert list(back.sensors) == list(scene.sensors)
    for name, sensor in scene.sensors.items():
        other = back.sensors[name]
        assert (other.channels, other.wavelengths_nm, other.polarizer_angles_deg) == (
            sensor.channels, sensor.wavelengths_nm, sensor.polarizer_angles_deg,
        )  # fmt: skip
        assert np.array_equal(other.mosaic, sensor.mosaic) if sensor.mosaic is not None else other.mosaic is None
    assert (back.split.train, back.split.test, back.unit) == (scene.split.train, scene.split.test, scene.unit)
    np.testing.assert_allclose((*back.region.centre, back.region.radius), (*scene.region.centre, scene.region.radius), atol=1e-9)
    assert [(f.sensor, f.view) for f in back.frames] == [(f.sensor, f.view) for f in scene.frames]
    points = np.random.default_rng(0).uniform([-0.3, -0.3, 1.0], [0.3, 0.3, 4.0], (20, 3))
    for mine, frame in zip(back.frames, scene.frames, strict=True):
        far = max(1.0, float(np.abs(frame.camera_to_world[:3, 3]).max()))
        np.testing.assert_allclose(mine.camera_to_world, frame.camera_to_world, atol=1e-9 * far)
        np.testing.assert_allclose(mine.camera.intrinsics, frame.camera.intrinsics, atol=1e-9)
        assert (mine.camera.width, mine.camera.height) == (frame.camera.width, frame.camera.height)
        assert mine.camera.lens == frame.camera.lens
        assert np.abs(project(points, mine.camera) - project(points, frame.camera)).max() < 1e-6  # pixels
        assert mine.path.read_bytes() == frame.path.read_bytes()
        assert (mine.mask is None) == (frame.mask is None)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    lens=st.sampled_from([(0, False), (4, False), (5, False), (8, False), (0, True), (4, True)]),
    far=st.sampled_from([1.0, 1e4]),
    layout=st.sampled_from(OURS),
)
def test_our_readers_give_back_any_lens_and_pose(
    tmp_path_factory: pytest.TempPathFactory, seed: int, lens: tuple[int, bool], far: float, layout: ExportLayout
) -> None:
    random, root = np.random.default_rng(seed), tmp_path_factory.mktemp("scene")
    camera = Camera(
        WIDTH, HEIGHT, *random.uniform(20, 40, 2), *random.uniform(8, 12, 2), tuple(random.normal(scale=0.02, size=lens[0])),
        "kannala_brandt" if lens[1] else "brown_conrady",
    )  # fmt: skip
    centre, turn = random.normal(size=3) * far, np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.random(random_state=seed).as_matrix(), centre
    frames = []
    for view, pose in enumerate(ring(3)):
        write_png16(root / f"{view:04d}.png", frame_values(view))
        frames.append(Frame("mono", 2 * view + 1, root / f"{view:04d}.png", camera, turn @ pose))
    region = Region((float(centre[0]), float(centre[1]), float(centre[2])), 1.0)
    scene = Scene(root, "nerfstudio", {"mono": Sensor("mono", ("mono",), (None,))}, tuple(frames), region, Split((1, 3), (5,), "test"), "m")
    out = tmp_path_factory.mktemp("out")
    assert export_scene(scene, out, layout=layout).frames == {"mono": 3}
    same_scene(load_scene(out), scene)


@pytest.mark.parametrize("layout", OURS)
def test_a_raw_rig_with_masks_and_test_views(write_mmsdata: Writer, tmp_path: Path, layout: ExportLayout) -> None:
    root = write_mmsdata(range(12))
    for view in (0, 3, 9):
        write_png(root / "masks" / "rgb" / f"{view:04d}.png", np.full((HEIGHT, WIDTH), 255 * (view % 2), np.uint8))
    (root / "gt" / "rgb").mkdir(parents=True)
    (root / "gt" / "rgb" / "0004.png").touch()
    scene = load_scene(root)
    assert scene.split.test == (4,)
    before = files_of(root)
    written = export_scene(scene, tmp_path / "out", layout=layout)
    assert (written.frames, written.masks, written.points) == ({"rgb": 12, "nir": 12}, 3, 0)
    assert any("gt/" in note for note in written.notes)
    back = load_scene(tmp_path / "out")
    same_scene(back, scene)
    for mine, frame in zip(back.frames, scene.frames, strict=True):
        assert mine.mask is None or frame.mask is None or mine.mask.read_bytes() == frame.mask.read_bytes()
    assert files_of(root) == before
    # and once more: to the same bytes, over what is there
    content = files_of(tmp_path / "out")
    export_scene(scene, tmp_path / "out", layout=layout)
    assert files_of(tmp_path / "out") == content


def test_a_colmap_model_of_a_rig(write_mmsdata: Writer, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    root = write_mmsdata(range(12))
    write_png(root / "masks" / "rgb" / "0003.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    scene = load_scene(root)
    written = export_scene(scene, tmp_path / "out", layout="colmap")
    assert written.masks == 1 and sum("no mosaics" in note for note in written.notes) == 1
    assert (tmp_path / "out" / "masks" / "rgb" / "0003.png.png").read_bytes() == (root / "masks" / "rgb" / "0003.png").read_bytes()
    assert (tmp_path / "out" / "sparse" / "0" / "test.txt").read_text() == "rgb/0009.png\nnir/0009.png\n"
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    assert (len(model.rigs), len(model.frames), len(model.images)) == (1, 12, 24)
    at = {image.name: image for image in model.images.values()}
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3)) + scene.region.centre
    for frame in scene.frames:
        image = at[f"{frame.sensor}/{frame.view:04d}.png"]
        assert (tmp_path / "out" / "images" / image.name).read_bytes() == frame.path.read_bytes()
        pose = np.linalg.inv(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
        np.testing.assert_allclose(pose, frame.camera_to_world, atol=1e-9)
        to_camera = np.linalg.inv(frame.camera_to_world)
        ours = project(points @ to_camera[:3, :3].T + to_camera[:3, 3], frame.camera)
        theirs = np.array([image.project_point(point) for point in points]) - 0.5
        assert np.abs(ours - theirs).max() < 1e-6  # pixels


@pytest.mark.parametrize("layout", LAYOUTS)
def test_sparse_points_go_along(write_transforms: Writer, tmp_path: Path, layout: ExportLayout) -> None:
    root = write_transforms(edit=lambda meta: meta.update(ply_file_path="points.ply"))
    random = np.random.default_rng(0)
    cloud, colours = random.uniform(-0.5, 0.5, (80, 3)), random.integers(0, 256, (80, 3), dtype=np.uint8)
    trimesh.PointCloud(cloud, colours).export(root / "points.ply")
    scene = load_scene(root)
    assert export_scene(scene, tmp_path / "out", layout=layout).points == 80
    if layout == "colmap":
        model = pytest.importorskip("pycolmap").Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
        found = [model.points3D[i + 1] for i in range(80)]
        positions, shades = np.array([point.xyz for point in found]), np.array([point.color for point in found])
    else:
        points = sparse_points(load_scene(tmp_path / "out"))
        assert points is not None
        positions, shades = points.positions, points.colours
    given = sparse_points(scene)
    assert given is not None
    np.testing.assert_allclose(positions, given.positions, atol=1e-12)
    np.testing.assert_allclose(positions, cloud, atol=1e-6)  # the file was in single precision
    np.testing.assert_array_equal(shades, colours)


@pytest.mark.parametrize("layout", OURS)
def test_poses_are_those_that_the_fit_corrected(write_mmsdata: Writer, tmp_path: Path, layout: ExportLayout) -> None:
    scene = load_scene(write_mmsdata(range(4)))
    small = Design(surface_levels=1, surface_rows_log2=4, surface_finest=16, radiance_levels=1, radiance_rows_log2=4, radiance_finest=16)
    field = Field(small, scene.sensors, dict.fromkeys(scene.sensors, 1.0), scene.region)
    still = export_scene(scene, tmp_path / "still", layout=layout, field=field)
    assert "left the poses" in still.notes[0]
    shift, turn = np.eye(4), np.eye(4)
    shift[0, 3], turn[:3, :3] = 0.01, Rotation.from_rotvec([0, 0, 0.002]).as_matrix()
    field.corrections = Corrections({0: shift}, {"nir": turn})
    moved = export_scene(scene, tmp_path / "moved", layout=layout, field=field)
    assert "at the most 0.01 and 0.115)" in moved.notes[0], moved.notes
    for mine, frame in zip(load_scene(tmp_path / "moved").frames, scene.frames, strict=True):
        expected = (shift if frame.view == 0 else np.eye(4)) @ frame.camera_to_world @ (turn if frame.sensor == "nir" else np.eye(4))
        np.testing.assert_allclose(mine.camera_to_world, expected, atol=1e-9)


def test_files_of_one_name_are_told_apart(write_transforms: Writer, tmp_path: Path) -> None:
    """train/r_0.png and test/r_0.png: by the ids of views."""

    def edit(meta: dict[str, Any]) -> None:
        for folder, entry in zip(("train", "test") * 2, meta["frames"], strict=True):
            source = tmp_path / "scene" / entry["file_path"]
            entry["file_path"] = f"{folder}/r_{int(source.stem) // 2}.png"
            target = tmp_path / "scene" / entry["file_path"]
            target.parent.mkdir(exist_ok=True)
            source.rename(target)

    scene = load_scene(write_transforms(edit=edit))
    for layout in OURS:
        export_scene(scene, tmp_path / layout, layout=layout)
        same_scene(load_scene(tmp_path / layout), scene)
    export_scene(scene, tmp_path / "colmap", layout="colmap")
    names = sorted(path.name for path in (tmp_path / "colmap" / "images").iterdir())
    assert names == [f"{view:04d}.png" for view in range(4)]


def test_what_a_layout_does_not_hold_is_said(write_transforms: Writer, tmp_path: Path) -> None:
    scene = load_scene(write_transforms())
    mask = tmp_path / "mask.png"
    write_png(mask, np.full((HEIGHT, WIDTH), 255, np.uint8))
    write_npz(tmp_path / "frame.npz", {"data": frame_values(0, 3)})
    masked = replace(scene, masks="object", frames=tuple(replace(frame, mask=mask) for frame in scene.frames))
    arrays = replace(scene, frames=tuple(replace(frame, path=tmp_path / "frame.npz") for frame in scene.frames))
    fisheye = replace(scene.frames[0].camera, lens="kannala_brandt", distortion=(0.01, 0.0, 0.0, 0.001))
    wide = replace(scene, frames=tuple(replace(frame, camera=fisheye) for frame in scene.frames))
    gaps = replace(scene, frames=tuple(replace(frame, view=3 * frame.view) for frame in scene.frames))
    cases: list[tuple[Scene, ExportLayout, str]] = [
        (masked, "nerfstudio", "say `--masks object`"), (masked, "mms-data", "say `--masks object`"), (arrays, "nerfstudio", ".npz files"),
        (wide, "mms-data", "OPENCV_FISHEYE, is none of MMS-DATA's"), (gaps, "mms-data", "gaps"), (scene, "colmap", "no region of interest"),
    ]  # fmt: skip
    for i, (case, layout, said) in enumerate(cases):
        notes = export_scene(case, tmp_path / str(i), layout=layout).notes
        assert any(said in note for note in notes), (said, notes)
    assert not export_scene(scene, tmp_path / "plain", layout="nerfstudio").notes


def test_bad_input_gets_one_sentence_and_writes_nothing(write_transforms: Writer, tmp_path: Path) -> None:
    root = write_transforms(edit=lambda meta: meta["frames"][1].update(fl_x=31.0))
    scene, out = load_scene(root), tmp_path / "out"
    with pytest.raises(InputError, match="2 cameras of 'rgb'"):
        export_scene(scene, out, layout="mms-data")
    with pytest.raises(InputError, match="expected one of mms-data, nerfstudio, colmap"):
        export_scene(scene, out, layout=cast("ExportLayout", "blender"))
    before = files_of(root)
    with pytest.raises(InputError, match=r"holds the scene's own images/0000\.png"):
        export_scene(scene, root, layout="colmap")
    assert files_of(root) == before
    scene.frames[3].path.write_bytes(scene.frames[3].path.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"0003\.png: truncated"):
        export_scene(scene, out, layout="colmap")
    assert not out.exists()


def test_the_command(write_mmsdata: Writer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from typer.testing import CliRunner

    monkeypatch.chdir(tmp_path)
    root = write_mmsdata(range(4))
    told = CliRunner().invoke(app, ["export", str(root), "--layout", "colmap", "--json"])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout)["frames"] == {"rgb": 4, "nir": 4} and (tmp_path / "scene-colmap" / "sparse" / "0" / "rigs.bin").is_file()
    text = CliRunner().invoke(app, ["export", str(root), "--layout", "mms-data", "--out", "again"])
    assert text.exit_code == 0 and "wrote again/ (mms-data: 4 of rgb, 4 of nir)" in text.stdout
    for wrong in (["export", str(root), "--layout", "tum"], ["export", "nowhere", "--layout", "colmap"]):
        told = CliRunner().invoke(app, wrong)
        assert told.exit_code == 2 and told.stderr.startswith("error: ") and told.stderr.count("\n") == 1
    assert all(path.suffix in (*SUFFIXES, ".json") for path in (tmp_path / "again").rglob("*") if path.is_file())
