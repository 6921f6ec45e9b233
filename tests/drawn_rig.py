"""A rig of five sensors and boards, as corners with noise or drawn through our own camera model."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mmsynth.scene.capture.board import Board, corner_points
from mmsynth.scene.capture.board_frames import SensorFrames
from mmsynth.scene.capture.detection import Detection
from mmsynth.scene.layouts.calibration import RigSensor
from mmsynth.scene.motion import inverse
from mmsynth.sensors.camera import Camera, project, ray_map

BOARD = Board(kind="charuco", squares=(5, 7), square=0.036, marker=0.027)
CHESSBOARD = Board(kind="chessboard", squares=(10, 7), square=0.03)
EVEN = Board(kind="chessboard", squares=(8, 6), square=0.036)


def pose_of(rotation: tuple[float, float, float], position: tuple[float, float, float]) -> np.ndarray:
    """(4, 4) from degrees about x, y, z and metres."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_euler("xyz", rotation, degrees=True).as_matrix(), position
    return out


def five_sensors() -> dict[str, RigSensor]:
    """Brown lenses, a fisheye, a pinhole; one is upside down, one rolled by a quarter turn."""
    lenses = {
        "rgb": (Camera(640, 480, 690.0, 688.0, 322.0, 236.0, (-0.12, 0.09, 6e-4, -9e-4)), np.eye(4)),
        "nir": (
            Camera(640, 512, 680.0, 681.0, 315.0, 259.0, (-0.2, 0.15, -7e-4, 5e-4)),
            pose_of((0.6, -2.1, 180.0), (0.062, 0.009, -0.004)),
        ),
        "mono": (Camera(640, 480, 900.0, 900.0, 318.0, 243.0), pose_of((-0.4, 2.3, -0.7), (-0.058, 0.004, 0.003))),
        "pol": (Camera(612, 512, 663.0, 663.0, 309.0, 252.0, (-0.16, 0.12, 9e-4, -3e-4)), pose_of((2.4, 0.3, 90.0), (0.006, 0.055, 0.002))),
        "ms": (
            Camera(636, 510, 360.0, 360.0, 322.0, 250.0, (-0.02, 0.004, -0.001, 0.0002), "kannala_brandt"),
            pose_of((-2.5, -0.5, -1.2), (-0.007, -0.061, -0.003)),
        ),
    }
    return {name: RigSensor(camera, place, {"mosaick_pattern": [[0]]}, name) for name, (camera, place) in lenses.items()}


def board_poses(count: int, seed: int = 0, tilt: float = 35.0, board: Board = BOARD, distance: float = 0.55) -> list[np.ndarray]:
    """(4, 4) board → reference each, in many directions, rolls and places."""
    random = np.random.default_rng(seed)
    middle = corner_points(board).mean(0)
    out = []
    for _ in range(count):
        pose = np.eye(4)
        axis = random.normal(size=2)
        axis *= np.radians(tilt * random.uniform(0.4, 1.0)) / np.linalg.norm(axis)
        turn = Rotation.from_rotvec([*axis, 0.0]) * Rotation.from_rotvec([0, 0, random.uniform(-0.6, 0.6)])
        pose[:3, :3] = turn.as_matrix()
        depth = distance * random.uniform(0.8, 1.3)
        place = np.array([*(random.uniform(-0.22, 0.22, 2) * depth), depth])
        pose[:3, 3] = place - pose[:3, :3] @ middle
        out.append(pose)
    return out


def seen_corners(
    rig: dict[str, RigSensor], poses: dict[str, list[np.ndarray]], board: Board = BOARD, noise: float = 0.05, seed: int = 1
) -> dict[str, SensorFrames]:
    """What detection would give: ``poses`` of the board for each sensor, at each instant."""
    random = np.random.default_rng(seed)
    out = {}
    for name, sensor in rig.items():
        camera, found = sensor.camera, {}
        for i, pose in enumerate(poses[name]):
            local = inverse(sensor.camera_to_reference) @ pose
            pixels = project(corner_points(board) @ local[:3, :3].T + local[:3, 3], camera)
            with np.errstate(invalid="ignore"):
                inside = ((pixels > 3) & (pixels < np.array([camera.width, camera.height]) - 4)).all(1)
            ids = np.flatnonzero(inside)
            enough = len(ids) >= 8 and (board.kind == "charuco" or len(ids) == len(pixels))
            noisy = pixels[ids] + noise * random.normal(size=(len(ids), 2))
            found[f"{i:03}"] = [Detection(0, ids, noisy, np.full(len(ids), noise))] if enough else []
        out[name] = SensorFrames(name, name, dict.fromkeys(found, None), (camera.width, camera.height), (1, 1), sensor.described, found)
    return out


@functools.lru_cache(maxsize=1)  # most draw several pictures of one camera
def _fine_rays(camera: Camera, samples: int) -> tuple[np.ndarray, np.ndarray]:
    return ray_map(
        Camera(
            camera.width * samples, camera.height * samples, camera.fx * samples, camera.fy * samples, (camera.cx + 0.5) * samples - 0.5,
            (camera.cy + 0.5) * samples - 0.5, camera.distortion, camera.lens,
        )
    )  # fmt: skip


def drawn(board: Board, pose: np.ndarray, camera: Camera, samples: int = 3) -> np.ndarray:
    """(H, W) float32: a board (4, 4 board → camera) on grey through a lens, by rays at several places of each photosite."""
    pixels = 48
    columns, rows = board.squares
    if board.kind == "charuco":
        ids = np.arange(board.first_id, board.first_id + columns * rows // 2)
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        art = cv2.aruco.CharucoBoard((columns, rows), board.square, board.marker, dictionary, ids).generateImage(
            (columns * pixels, rows * pixels)
        )
    else:
        art = 255 * (np.add.outer(np.arange(rows), np.arange(columns)) % 2).astype(np.uint8).repeat(pixels, 0).repeat(pixels, 1)
    art = art.astype(np.float32) / 255
    if board.inverted:
        art = 1 - art
    start = 0.0 if board.kind == "charuco" else -board.square
    rays, valid = _fine_rays(camera, samples)
    to_board = inverse(pose)
    directions, origin = to_board[:3, :3] @ rays.reshape(-1, 3).T, to_board[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = -origin[2] / directions[2]
        x, y = ((((origin[i] + away * directions[i]) - start) / board.square * pixels - 0.5).reshape(valid.shape) for i in (0, 1))

    def within(least: float, most: float) -> np.ndarray:
        return valid & (x > least) & (y > least) & (x < columns * pixels + most) & (y < rows * pixels + most)

    inside, margin = within(-0.5, -0.5), within(-pixels / 2, pixels / 2)
    picture = np.where(margin, np.float32(0.0 if board.inverted else 1.0), np.float32(0.45))
    places = (np.where(inside, at, 0.0).astype(np.float32) for at in (x, y))
    picture = np.where(inside, cv2.remap(art, *places, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE), picture)
    mean = picture.reshape(camera.height, samples, camera.width, samples).mean((1, 3))
    return (0.05 + 0.7 * mean).astype(np.float32)
