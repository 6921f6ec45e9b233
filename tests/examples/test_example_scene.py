"""The example scene on disk, and (oracle) the Stokes convention of the script that rendered it."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from mmsynth.sensors.camera import Camera, project, ray_map
from mmsynth.sensors.mosaic import mosaic
from mmsynth.sensors.polarization import angle_of_linear_polarization, stokes_to_intensities

EXAMPLES = Path(__file__).parents[2] / "examples"
SCENE = EXAMPLES / "example_scene"
CHANNELS = {"rgb": 3, "infrared": 1, "mono": 1, "polarization": 4, "multispectral": 9}
TEST_VIEWS = (9, 19)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("render_example_scene", EXAMPLES / "render_example_scene.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def meta() -> dict[str, Any]:
    return json.loads((SCENE / "meta_data.json").read_text())


def camera_of(entry: dict[str, Any]) -> Camera:
    numbers = [entry[key] for key in ("width", "height", "fx", "fy", "cx", "cy")]
    return Camera(*numbers, tuple(entry["distortion_params"]))


def camera_to_gt(meta: dict[str, Any], name: str, view: int) -> np.ndarray:
    """(4, 4) [m], OpenCV axes."""
    to_gt = np.array(meta["worldtogt"])
    pose = np.eye(4)
    pose[:3] = meta["modalities"][name]["frames"][view]["camtoworld"]
    pose = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = (to_gt @ np.append(pose[:3, 3], 1.0))[:3]
    return pose


def test_small_enough() -> None:
    assert sum(path.stat().st_size for path in SCENE.rglob("*") if path.is_file()) <= 3_000_000


def test_layout(meta: dict[str, Any]) -> None:
    calibration = json.loads((SCENE / "calibration.json").read_text())
    assert (meta["raw"], meta["undistorted"], meta["pixel_offset"]) == (True, False, 0.0)
    assert list(meta["modalities"]) == list(calibration) == list(CHANNELS)
    for name, entry in meta["modalities"].items():
        assert np.unique(entry["mosaick_pattern"]).tolist() == list(range(CHANNELS[name]))
        assert ray_map(camera_of(entry))[1].all()
        assert [frame["frame_id"] for frame in entry["frames"]] == list(range(24))
        for frame in entry["frames"]:
            raw = cv2.imread(str(SCENE / "modalities" / name / frame["file_name"]), cv2.IMREAD_UNCHANGED)
            assert raw.dtype == np.uint16 and raw.shape == (entry["height"], entry["width"])
            assert name == "polarization" or not np.any(raw & 15), "12-bit codes are aligned to the top"
        for view in TEST_VIEWS:
            data = np.load(SCENE / f"gt/{name}/{view:04d}.npz")["data"]
            channels = 3 if name == "polarization" else CHANNELS[name]  # S0, S1, S2
            assert data.dtype == np.float16 and data.shape == (entry["height"], entry["width"], channels)
            assert np.load(SCENE / f"gt/masks/{view:04d}_{name}.npz")["in_roi"].shape == data.shape[:2]
    shape = (meta["modalities"]["rgb"]["height"], meta["modalities"]["rgb"]["width"])
    for view in TEST_VIEWS:
        aligned = np.load(SCENE / f"gt/aligned/{view:04d}.npz")
        assert {key: aligned[key].shape for key in aligned if key != "spp"} == {
            "infrared": (*shape, 1), "mono": (*shape, 1), "polarization": (*shape, 3), "multispectral": (*shape, 9)}  # fmt: skip
        assert set(np.load(SCENE / f"gt/geometry/{view:04d}.npz")) == {"depth_z", "depth_ray", "normal", "label", "in_roi"}


@pytest.mark.parametrize("view", range(0, 24, 5))
@pytest.mark.parametrize("name", CHANNELS)
def test_poses_are_rigid_and_agree_with_the_rig(meta: dict[str, Any], name: str, view: int) -> None:
    calibration = json.loads((SCENE / "calibration.json").read_text())
    pose = camera_to_gt(meta, name, view)
    assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9) and np.linalg.det(pose[:3, :3]) > 0
    assert np.allclose(pose, camera_to_gt(meta, "rgb", view) @ np.array(calibration[name]["camera2reference"]), atol=1e-9)


def truth_and_raw(meta: dict[str, Any], name: str, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Noise-free and measured light at each photosite (H, W), 1.0 = full scale."""
    data = np.load(SCENE / f"gt/{name}/{view:04d}.npz")["data"].astype(np.float64)
    if name == "polarization":
        data = stokes_to_intensities(torch.from_numpy(data), (0.0, 45.0, 90.0, 135.0)).numpy()
    raw = cv2.imread(str(SCENE / f"modalities/{name}/{view:04d}.png"), cv2.IMREAD_UNCHANGED)
    pattern = np.array(meta["modalities"][name]["mosaick_pattern"])
    return mosaic(torch.from_numpy(data).movedim(-1, 0), pattern).numpy(), raw / 65535.0


@pytest.mark.parametrize("view", TEST_VIEWS)
@pytest.mark.parametrize("name", CHANNELS)
def test_raw_is_truth_plus_noise(meta: dict[str, Any], name: str, view: int) -> None:
    truth, raw = truth_and_raw(meta, name, view)
    use = (truth > 0.02) & (truth < 0.85)
    assert use.sum() > 2000
    # shot and read noise; 12-bit codes << 4 top out at 65520
    sigma = np.sqrt(truth / 1e4 + 25e-8)
    z = ((raw * (65535 / 65520 if name != "polarization" else 1.0) - truth) / sigma)[use]
    assert abs(z.mean()) < 4 * z.std() / np.sqrt(use.sum()) and abs(((raw - truth)[use]).mean()) < 0.001
    # the path tracer's own noise, of frame and truth, comes on top of the sensor's
    assert 0.95 < 1.4826 * np.median(np.abs(z)) < 2.5
    assert -10 * np.log10(np.mean((raw - np.clip(truth, 0, 1)) ** 2)) > 38
    assert np.median(raw[truth == 0]) <= 16 / 65535 * 4, "around the objects is black"


@pytest.mark.parametrize("name", CHANNELS)
def test_exposure(meta: dict[str, Any], name: str) -> None:
    frames = [cv2.imread(str(SCENE / f"modalities/{name}/{view:04d}.png"), cv2.IMREAD_UNCHANGED) for view in range(24)]
    assert 0.7 < np.percentile(np.stack(frames) / 65535, 99.5) < 0.9


@pytest.mark.parametrize("view", TEST_VIEWS)
def test_stokes_is_physical(view: int) -> None:
    for file, key in (("polarization", "data"), ("aligned", "polarization")):
        stokes = np.load(SCENE / f"gt/{file}/{view:04d}.npz")[key]
        s0, s1, s2 = np.moveaxis(stokes.astype(np.float64), -1, 0)
        strength = np.hypot(s1, s2)
        assert np.all(s0 >= strength - 1e-3)
        assert np.percentile(strength[s0 > 0.02] / s0[s0 > 0.02], 99) > 0.15, "something in the scene polarizes"


def test_depths_of_two_views_agree(meta: dict[str, Any]) -> None:
    camera = camera_of(meta["modalities"]["rgb"])
    directions = ray_map(camera)[0]
    first, second = (np.load(SCENE / f"gt/geometry/{view:04d}.npz") for view in TEST_VIEWS)
    poses = [camera_to_gt(meta, "rgb", view) for view in TEST_VIEWS]
    depth = first["depth_ray"].astype(np.float64)
    seen = depth > 0
    assert np.array_equal(seen, first["in_roi"]) and np.array_equal(seen, first["label"] > 0)
    assert np.allclose(first["depth_z"], depth * directions[..., 2], atol=1e-5)
    points = (directions * depth[..., None])[seen] @ poses[0][:3, :3].T + poses[0][:3, 3]
    assert points[first["label"][seen] == 1][:, 2].max() < 1e-4, "the table top is z = 0"
    local = (points - poses[1][:3, 3]) @ poses[1][:3, :3]
    u, v = np.round(project(local, camera)).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    gap = local[inside, 2] - second["depth_z"][v[inside], u[inside]]
    label, other = first["label"][seen][inside], second["label"][v[inside], u[inside]]
    same = (label == other) & (label == 1)  # the table: never hidden where it is also seen
    # half a pixel sideways on a plane seen at 50 degrees is 2 mm of depth
    assert same.sum() > 300 and np.percentile(np.abs(gap[same]), 95) < 0.004 and abs(np.median(gap[same])) < 5e-4


def test_orbit_is_a_nerfstudio_file(meta: dict[str, Any]) -> None:
    orbit = json.loads((SCENE / "poses.json").read_text())
    rgb = meta["modalities"]["rgb"]
    assert (orbit["w"], orbit["h"], orbit["fl_x"], orbit["cx"]) == (rgb["width"], rgb["height"], rgb["fx"], rgb["cx"] + 0.5)
    for frame in orbit["frames"]:
        pose = np.array(frame["transform_matrix"])
        assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
        towards = np.array([0.0, 0.0, 0.05]) - pose[:3, 3]
        assert -pose[:3, 2] @ towards > 0.99 * np.linalg.norm(towards), "looks along -z at the scene"
    assert len(orbit["frames"]) == 12


def test_twin_spheres_are_metamers(script: ModuleType) -> None:
    paints, responses = script.reflectances(), script.responses()
    a, b = paints["teal_a"], paints["teal_b"]
    assert np.allclose(responses["rgb"] @ a, responses["rgb"] @ b, atol=1e-9)
    assert np.abs(responses["multispectral"] @ (a - b)).max() > 0.1
    assert (responses["infrared"] @ (b - a))[0] > 0.4
    labels = json.loads((SCENE / "gt/labels.json").read_text())
    assert list(labels.values()) == list(script.LABELS)


@pytest.mark.oracle
@pytest.mark.parametrize("roll_deg", [0.0, 20.0, -35.0])
def test_brewster_reflection(script: ModuleType, roll_deg: float) -> None:
    """At Brewster's angle a pane reflects only light polarized along itself: S0 and angle are known."""
    pytest.importorskip("mitsuba")
    try:
        mi = script.load_mitsuba()
    except ImportError as error:  # no LLVM
        pytest.skip(str(error))
    index = 1.5
    brewster = np.arctan(index)
    eye = np.array([0.0, -np.sin(brewster), np.cos(brewster)])
    white = script.spectrum(np.ones_like(script.WAVELENGTHS))
    place = mi.ScalarTransform4f().look_at(origin=[0.0, 2 * np.sin(brewster), 2 * np.cos(brewster)], target=[0, 0, 0], up=[0, 0, 1])
    scene = mi.load_dict({
        "type": "scene",
        "pane": {"type": "rectangle", "bsdf": {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}},
        "lamp": {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": white}},
    })  # fmt: skip
    camera = Camera(32, 32, 20000.0, 20000.0, 15.5, 15.5)
    table = script.wavelength_table(script.responses()["mono"])
    pose = script.look_at(eye, np.zeros(3), roll_deg)
    stokes = script.render(mi, scene, camera, pose, table, np.zeros((32, 32), int), 1024, 1).mean((0, 1))
    # Fresnel: R_s = sin²(θi − θt), R_p = 0; lamp of radiance 1
    assert stokes[0] == pytest.approx(0.5 * np.sin(2 * brewster - np.pi / 2) ** 2, rel=0.02)
    assert np.hypot(*stokes[1:]) == pytest.approx(stokes[0], rel=1e-3)
    # a camera turned counter-clockwise (seen from behind) sees the horizontal direction turned clockwise
    assert float(angle_of_linear_polarization(torch.from_numpy(stokes))) == pytest.approx(-roll_deg, abs=0.2)
