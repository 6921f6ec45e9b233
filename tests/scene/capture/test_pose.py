"""Poses of pictures drawn here by texture mapping, with pycolmap; what cannot be posed gets one sentence."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mmsynth.errors import InputError
from mmsynth.scene.capture.board import Board
from mmsynth.scene.capture.likely_pairs import likely_pairs
from mmsynth.scene.capture.matching_picture import matching_picture
from mmsynth.scene.capture.metric import scale_of_boards
from mmsynth.scene.capture.pose import PosedCapture, pose_capture, write_posed
from mmsynth.scene.capture.source import read_capture
from mmsynth.scene.known_sensors import make_sensor
from mmsynth.scene.layouts.calibration import RigSensor, write_calibration
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Frame
from mmsynth.sensors.camera import Camera, ray_map
from mmsynth.workflows.pose import pose_facts

CAMERA = Camera(320, 240, 330.0, 331.0, 158.0, 121.0, (-0.08, 0.03, 0.0005, -0.0004))
Plane = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # origin, two edges, texture


def _noise(seed: int, size: int = 700) -> np.ndarray:
    random = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(random.normal(size=(size, size)), (0, 0), s) * s for s in (1.5, 3.0, 7.0, 15.0)]
    picture = np.sum(layers, axis=0)
    return np.asarray(0.5 + 0.18 * picture / picture.std(), dtype=np.float32).clip(0.02, 0.98)


FLOOR = (np.array([-1.0, -1.0, 0.0]), np.array([2.0, 0.0, 0.0]), np.array([0.0, 2.0, 0.0]), _noise(1))
TENT = [
    (np.array([-0.4, -0.3, 0.0]), np.array([0.0, 0.6, 0.0]), np.array([0.4, 0.0, 0.35]), _noise(2)),
    (np.array([0.0, -0.3, 0.35]), np.array([0.0, 0.6, 0.0]), np.array([0.4, 0.0, -0.35]), _noise(3)),
]


@functools.lru_cache(1)
def _rays(camera: Camera) -> np.ndarray:
    return ray_map(camera)[0]


def _draw(camera: Camera, pose: np.ndarray, planes: Sequence[Plane]) -> np.ndarray:
    """(H, W) float32 in [0, 1]: the nearest of textured parallelograms."""
    shape = camera.height, camera.width
    directions = (_rays(camera).reshape(-1, 3) @ pose[:3, :3].T).astype(np.float64)
    out, depth = np.full(len(directions), 0.3, np.float32), np.full(len(directions), np.inf)
    for origin, a, b, texture in planes:
        normal, away = np.cross(a, b), pose[:3, 3] - origin
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -(away @ normal) / (directions @ normal)
            at = away + t[:, None] * directions
            u, v = (at @ np.cross(x, y) / (normal @ normal) for x, y in ((b, normal), (normal, a)))
        hit = (u >= 0) & (u < 1) & (v >= 0) & (v < 1) & (t > 0) & (t < depth)
        at = [(x * side - 0.5).astype(np.float32).reshape(shape) for x, side in ((u, texture.shape[1]), (v, texture.shape[0]))]
        values = cv2.remap(texture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
        out, depth = np.where(hit, values, out), np.where(hit, t, depth)
    return out.reshape(shape)


def _looking(position: Sequence[float], target: Sequence[float] = (0.0, 0.0, 0.1)) -> np.ndarray:
    pose = np.eye(4)
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], -1), position
    return pose


def _arc(count: int) -> list[np.ndarray]:
    angles = np.linspace(-0.6, 0.6, count)
    return [_looking((1.1 * np.sin(a), -1.1 * np.cos(a), 0.8 + 0.1 * np.sin(3 * a))) for a in angles]


def _write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def _eight(image: np.ndarray) -> np.ndarray:
    return np.asarray(np.round(255 * image), dtype=np.uint8)


def _photos(folder: Path, poses: Sequence[np.ndarray], planes: Sequence[Plane]) -> Path:
    for i, pose in enumerate(poses):
        _write(folder / f"photo_{i}.png", _eight(_draw(CAMERA, pose, planes)))
    return folder


def _apart(posed: PosedCapture, truth: Callable[[str, int], np.ndarray], scale_free: bool) -> tuple[np.ndarray, np.ndarray, float]:
    """Positions off [units of the truth], rotations off [degrees] after the best similarity or rigid motion, and the best scale."""
    shots = list(posed.structure.registered)
    ours = np.stack([posed.structure.registered[s].camera_to_world for s in shots])
    theirs = np.stack([truth(*s) for s in shots])
    a, b = ours[:, :3, 3] - ours[:, :3, 3].mean(0), theirs[:, :3, 3] - theirs[:, :3, 3].mean(0)
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation, scale = u @ sign @ vt, float((values * np.diag(sign)).sum() / (a**2).sum())
    off = np.linalg.norm((scale if scale_free else 1.0) * a @ rotation.T - b, axis=1)
    turned = Rotation.from_matrix(rotation @ ours[:, :3, :3] @ theirs[:, :3, :3].transpose(0, 2, 1)).magnitude()
    return off, np.degrees(turned), scale


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[np.ndarray], PosedCapture]:
    pytest.importorskip("pycolmap")
    poses = _arc(7)
    folder = _photos(tmp_path_factory.mktemp("photos"), poses, [FLOOR, *TENT])
    return folder, poses, pose_capture(read_capture(folder))


def test_a_folder_of_photographs_is_posed_up_to_a_similarity(photos: tuple[Path, list[np.ndarray], PosedCapture]) -> None:
    _, poses, posed = photos
    assert len(posed.structure.registered) == 7 and not posed.lost
    assert posed.unit == "input unit" and "neither a board nor" in posed.unit_from
    off, _, _ = _apart(posed, lambda _, view: poses[view], scale_free=True)
    assert np.median(off) < 0.02  # of a path of 1.3, with a lens that nothing is known of


def test_the_scene_holds_the_files_as_they_are_and_reads_back(photos: tuple[Path, list[np.ndarray], PosedCapture], tmp_path: Path) -> None:
    folder, _, posed = photos
    scene = load_scene(write_posed(posed, tmp_path / "scene"))
    assert len(scene.frames) == 7 and not any("also holds" in problem for problem in scene.problems)
    for frame in scene.frames:
        shot = posed.structure.registered[frame.sensor, frame.view]
        assert frame.path.read_bytes() == (folder / frame.path.name).read_bytes()
        np.testing.assert_allclose(frame.camera_to_world, shot.camera_to_world, atol=1e-9)
        assert frame.camera.fx == pytest.approx(shot.camera.fx, rel=1e-12)
    import pycolmap

    model = pycolmap.Reconstruction(tmp_path / "scene" / "sparse" / "0")
    assert {image.name for image in model.images.values()} == {f"mono/{frame.path.name}" for frame in scene.frames}


def test_the_same_pictures_give_the_same_poses(photos: tuple[Path, list[np.ndarray], PosedCapture]) -> None:
    folder, _, posed = photos
    again = pose_capture(read_capture(folder))
    for shot, registered in posed.structure.registered.items():
        np.testing.assert_array_equal(again.structure.registered[shot].camera_to_world, registered.camera_to_world)


@pytest.mark.parametrize("bent", [0.0, 0.3], ids=["as calibrated", "bent by 0.3 degrees"])
def test_a_rig_of_a_mosaic_and_a_mono_sensor_is_posed_in_metres(tmp_path: Path, bent: float) -> None:
    pytest.importorskip("pycolmap")
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = Rotation.from_rotvec([0.01, -0.03, 0.02]).as_matrix(), [0.12, 0.01, -0.02]
    other = Camera(300, 240, 300.0, 300.5, 150.0, 118.0, (-0.1, 0.04, 0.0, 0.0))
    stated = place.copy()
    stated[:3, :3] = place[:3, :3] @ Rotation.from_rotvec([np.radians(bent), 0.0, 0.0]).as_matrix()
    poses, gain = _arc(6), np.array([[0.9, 0.5], [0.35, 0.9]])
    for i, pose in enumerate(poses):
        colour = _draw(CAMERA, pose, [FLOOR, *TENT]) ** 2 * np.tile(gain, (120, 160))
        _write(tmp_path / "modalities" / "rgb" / f"{i:04d}.png", np.round(65535 * colour).astype(np.uint16))
        grey = _draw(other, pose @ place, [FLOOR, *TENT]) ** 2
        _write(tmp_path / "modalities" / "mono" / f"{i:04d}.png", np.round(65535 * grey).astype(np.uint16))
    rig = {"rgb": RigSensor(CAMERA, np.eye(4), {"mosaick_pattern": [[1, 2], [0, 1]]}), "mono": RigSensor(other, stated)}
    write_calibration(tmp_path / "calibration.json", rig)
    posed = pose_capture(read_capture(tmp_path))
    assert posed.unit == "m" and len(posed.structure.registered) == 12
    off, turned, scale = _apart(posed, lambda name, view: poses[view] @ (place if name == "mono" else np.eye(4)), scale_free=False)
    assert scale == pytest.approx(1.0, abs=0.005)
    assert np.median(off) < 0.005 and np.median(turned) < 0.2
    moved = pose_facts(posed)["rig_moved"]
    assert not moved if bent == 0 else moved["mono"]["degrees"] == pytest.approx(bent, abs=0.1)
    for view in range(6):  # one pose for each instant
        shots = posed.structure.registered
        found = posed.structure.places["mono"]
        np.testing.assert_allclose(shots["rgb", view].camera_to_world @ found, shots["mono", view].camera_to_world, atol=1e-9)
        np.testing.assert_array_equal(shots["rgb", view].camera.coefficients, CAMERA.coefficients)


@pytest.mark.parametrize("world", [1.0, 0.4])
def test_boards_give_the_unit(tmp_path: Path, world: float) -> None:
    """A board of 36 mm squares in a world whose unit is another."""
    board = Board(kind="charuco", squares=(5, 7), square=0.036, marker=0.027)
    drawn = cv2.aruco.CharucoBoard((5, 7), 0.036, 0.027, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100))
    texture = np.asarray(drawn.generateImage((500, 700)), dtype=np.float32) / 255 * 0.8 + 0.1
    lies = (np.array([-0.09, 0.126, 0.0]), np.array([0.18, 0.0, 0.0]), np.array([0.0, -0.252, 0.0]), texture)
    frames = []
    for i, angle in enumerate(np.linspace(-0.5, 0.5, 4)):
        pose = _looking((0.35 * np.sin(angle), -0.3 * np.cos(angle), 0.35), (0.0, 0.0, 0.0))
        _write(tmp_path / f"{i}.png", _eight(_draw(CAMERA, pose, [lies])))
        pose[:3, 3] *= world
        frames.append(Frame("mono", i, tmp_path / f"{i}.png", CAMERA, pose))
    sensor = make_sensor("mono", {}, "", np.zeros((2, 2), np.uint8), raw=False)
    found = scale_of_boards(frames, sensor, [board], "here")
    assert found.scale == pytest.approx(1 / world, rel=2e-3)
    assert found.deviation < 2e-3 and found.corners >= 20
    with pytest.raises(InputError, match="0 of 2 frames"):
        scale_of_boards(frames[:2], sensor, [board.model_copy(update={"first_id": 40})], "here")


# --- hard cases


def _refused(folder: Path) -> str:
    pytest.importorskip("pycolmap")
    with pytest.raises(InputError) as caught:
        pose_capture(read_capture(folder))
    return str(caught.value)


def test_pictures_without_texture_are_refused(tmp_path: Path) -> None:
    for i in range(4):
        _write(tmp_path / f"{i}.png", np.full((240, 320), 90 + i, np.uint8))
    assert "no texture" in _refused(tmp_path)


def test_identical_pictures_are_refused(tmp_path: Path) -> None:
    picture = _eight(_draw(CAMERA, _arc(3)[0], [FLOOR, *TENT]))
    for i in range(4):
        _write(tmp_path / f"{i}.png", picture)
    assert "all 4 pictures of 'mono' are the same" in _refused(tmp_path)


def test_one_identical_picture_is_left_out(tmp_path: Path, photos: tuple[Path, list[np.ndarray], PosedCapture]) -> None:
    for path in photos[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "photo_9.png").write_bytes((tmp_path / "photo_2.png").read_bytes())
    posed = pose_capture(read_capture(tmp_path))
    assert posed.lost == {("mono", 7): "the same picture as photo_2.png"} and len(posed.structure.registered) == 7


def test_pictures_that_share_nothing_are_refused(tmp_path: Path) -> None:
    for i in range(4):
        _write(tmp_path / f"{i}.png", _eight(_noise(50 + i, 160)))
    assert "no matches" in _refused(tmp_path)


def test_pure_rotation_is_refused(tmp_path: Path) -> None:
    start = _looking((0.0, -1.0, 0.8))
    turns = []
    for angle in np.linspace(-0.15, 0.15, 6):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec([0.3 * angle, angle, 0.0]).as_matrix()
        turns.append(start @ turn)
    text = _refused(_photos(tmp_path, turns, [FLOOR, *TENT]))
    assert "no parallax" in text and "only turned" in text


def test_a_planar_scene_says_so(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    folder = _photos(tmp_path, _arc(6), [FLOOR])
    try:
        notes = " ".join(pose_capture(read_capture(folder)).notes)
    except InputError as error:
        notes = str(error)
    assert "plane" in notes


def test_without_pycolmap_the_sentence_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for i in range(3):
        _write(tmp_path / f"{i}.png", np.full((24, 32), 90 + i, np.uint8))
    with pytest.raises(InputError, match=r"pip install 'mmsynth\[capture\]'"):
        pose_capture(read_capture(tmp_path))


# --- pieces


@pytest.mark.parametrize("pattern", [[[1, 2], [0, 1]], [[4, 5, 6], [2, 1, 0], [3, 8, 7]]])
def test_the_picture_for_matching_has_no_pattern_and_does_not_move(pattern: list[list[int]]) -> None:
    """A grey blob on a mosaic of unequal channels stays where it is; flat light gives a flat picture."""
    tile = np.array(pattern)
    gains = np.random.default_rng(0).uniform(0.2, 1.0, tile.max() + 1)[np.tile(tile, (60, 60))[:120, :120]]
    v, u = np.mgrid[:120, :120]
    blob = 0.2 + 0.6 * np.exp(-((u - 57.3) ** 2 + (v - 61.6) ** 2) / (2 * 9.0**2))
    sensor = make_sensor("any", {"mosaick_pattern": pattern}, "", np.zeros((120, 120), np.uint16), raw=True)
    flat = matching_picture(np.round(40000 * gains).astype(np.uint16), sensor)
    assert int(flat.max()) - int(flat.min()) <= 1
    grey = matching_picture(np.round(60000 * blob * gains).astype(np.uint16), sensor).astype(float) ** 2
    weight = np.clip(grey - np.quantile(grey, 0.5), 0, None) * (grey > 0.25 * grey.max())
    assert (weight * u).sum() / weight.sum() == pytest.approx(57.3, abs=0.15)
    assert (weight * v).sum() / weight.sum() == pytest.approx(61.6, abs=0.15)


def test_likely_pairs_are_those_that_share_features() -> None:
    """Thirty pictures in a ring, each with half of its neighbour's features; opposite ones share nothing."""
    random = np.random.default_rng(0)
    features = random.integers(0, 200, (30, 60, 128)).astype(np.uint8)
    pictures = [np.concatenate([features[i], features[(i + 1) % 30]]) for i in range(30)]
    pairs = likely_pairs(pictures, [np.ones(120)] * 30)
    assert (0, 29) in pairs and all((i, i + 1) in pairs for i in range(29))
    assert len(pairs) < 30 * 29 / 4
    assert len(likely_pairs(pictures[:6], [np.ones(120)] * 6)) == 15


def test_views_and_sensors_are_named_by_files_and_folders(tmp_path: Path) -> None:
    for folder in ("rgb", "infrared"):
        for stem in ("10", "9", "2"):
            _write(tmp_path / folder / f"{stem}.png", np.zeros((8, 8) if folder == "infrared" else (8, 8, 3), np.uint8))
    capture = read_capture(tmp_path)
    assert [s.sensor.name for s in capture.sensors] == ["rgb", "nir"] and list(capture.sensors[0].files) == [2, 9, 10]
    assert read_capture(tmp_path, reference="infrared").sensors[0].sensor.name == "nir"
    with pytest.raises(InputError, match="no such sensor"):
        read_capture(tmp_path, reference="ms")
    with pytest.raises(InputError, match="no pictures"):
        (tmp_path / "empty").mkdir()
        read_capture(tmp_path / "empty")
