"""The pose of a frame that has none, by comparison with the field.

1. ArUco markers (those of ChArUco boards, too) that the scene's training frames show give a pose at once. So do features (SIFT, as
   root-SIFT) of the training frames of the same sensor, each with its place on the field's surface; those of the new frame are matched to
   the five training frames that share most with it. PnP with RANSAC.
2. The pose is refined on the photosites themselves (Gauss-Newton, damped, robust): render, compare, move; the frame's exposure is free.

The covariance is that of the second step: what the field is wrong by counts as noise that goes together within blocks of 16
pixels. What the field has out of place as a whole is not in it: against poses that are known exactly, errors are one to three of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.operations.output.progress import Progress
from mmsynth.scene.capture.boards import Corner, board_corners, markers_in
from mmsynth.scene.images import load_frame
from mmsynth.scene.motion import motion_to_matrix
from mmsynth.scene.scene import Scene
from mmsynth.sensors.camera import Camera, project, ray_map, unproject
from mmsynth.sensors.mosaic import channel_map, grey_of

if TYPE_CHECKING:
    from mmsynth.field.field import Field

LEAST_INLIERS = 12
WORST_SD_PX = 1.0
WORST_RESIDUAL = 0.6
_GOOD_RESIDUAL = 0.4
_LEAST_GUESS = 6
_LARGER = 2  # frames are enlarged before features are sought: small pictures have few
_NEIGHBOURS = 5
_RATIO = 0.8  # Lowe's
_RANSAC_PX = 2.0
_RAYS, _STEPS = 4000, 12
_HUBER = 0.03  # of residuals over the root of the light
_BLOCK = 16  # px: errors of a field go together over a few pixels


@dataclass(frozen=True)
class Features:
    """Features of one training frame: places (N, 3) in the scene's frame, descriptors (N, 128)."""

    places: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True)
class Landmarks:
    """What an unposed frame is matched with: features of each training frame, and places of marker corners, (3,) each."""

    features: list[Features]
    markers: dict[Corner, np.ndarray]


@dataclass(frozen=True)
class Registered:
    """A frame's pose.

    Attributes:
        pose: (4, 4) camera_to_world. covariance: (6, 6) of a motion in the camera's axes, rotation [rad] and translation [scene unit].
        sd_px: root mean square displacement of the picture by one standard deviation of the pose [px]. inliers: features that agree.
        exposure: of the frame, in units of those that the field learned from. residual: rms of the light, relative.
    """

    pose: np.ndarray
    covariance: np.ndarray
    sd_px: float
    inliers: int
    exposure: float
    residual: float


def landmarks(field: Field, scene: Scene, source: str, *, progress: Progress | None = None) -> Landmarks:
    """Features and markers of the training frames of a sensor, on the field's surface; once for any number of frames to register."""
    sensor = field.sensors[source]
    frames = [replace(frame, camera_to_world=field.pose_of(frame)) for frame in scene.frames_of(source, scene.split.train)]
    out = []
    for done, frame in enumerate(frames, 1):
        points, descriptors = _features(grey_of(load_frame(sensor, frame)[0], sensor.mosaic))
        pose = frame.camera_to_world
        rays, valid = unproject(points, frame.camera)
        depth = field.cast(rays, pose, [], False)["depth"].astype(np.float64) * field.region.radius if len(rays) else np.zeros(0)
        valid &= np.isfinite(depth)
        out.append(Features((pose[:3, 3] + rays @ pose[:3, :3].T * depth[:, None])[valid], descriptors[valid]))
        if progress is not None:
            progress(done, len(frames))
    return Landmarks(out, board_corners(frames, lambda frame: grey_of(load_frame(sensor, frame)[0], sensor.mosaic)))


def register(field: Field, known: Landmarks, raw: np.ndarray, camera: Camera, source: str, *, name: str = "frame") -> Registered:
    """Find the pose of one frame.

    Args:
        known: see ``landmarks``. raw: (H, W) of a mosaic, else (H, W, C). name: for errors.
    Raises:
        InputError: too few features agree with the field, the frame does not look as the field does from there, or the pose is not certain
            to a pixel; with the figures.
    """
    grey = grey_of(raw, field.sensors[source].mosaic)
    points, descriptors = _features(grey)
    guesses = _by_markers(markers_in(grey), camera, known.markers) + _by_features(points, descriptors, camera, known.features)
    inliers = max((count for _, count in guesses), default=0)
    if inliers < LEAST_INLIERS:
        raise InputError(
            f"{name}: {inliers} features agree with the field, expected at least {LEAST_INLIERS}: it does not show this scene."
        )
    # features that repeat agree on wrong poses, too: what the frame shows there decides
    found = None
    for pose, count in guesses:
        refined = _refined(field, raw, camera, pose, source, count)
        if found is None or refined.residual < found.residual:
            found = refined
        if found.residual < _GOOD_RESIDUAL:
            break
    assert found is not None
    if not found.residual < WORST_RESIDUAL:
        raise InputError(
            f"{name}: at the best pose its light differs from the field's by {found.residual:.0%}, expected less than {WORST_RESIDUAL:.0%}."
        )
    if not found.sd_px < WORST_SD_PX:
        raise InputError(f"{name}: its pose is uncertain by {found.sd_px:.2g} pixels, expected less than {WORST_SD_PX:g}.")
    return found


def _by_markers(seen: dict[Corner, np.ndarray], camera: Camera, known: dict[Corner, np.ndarray]) -> list[tuple[np.ndarray, int]]:
    """A guess of the pose from the corners of markers, if enough of them are known."""
    shared = sorted(seen.keys() & known.keys())
    if len(shared) < LEAST_INLIERS:
        return []
    places = np.array([known[corner] for corner in shared])
    pose, count = _by_points(np.array([seen[corner] for corner in shared]), camera, [(np.arange(len(shared)), places)])
    return [] if pose is None else [(pose, count)]


def _features(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 2) px and root-SIFT descriptors (N, 128) of a frame (H, W)."""
    bright = max(float(np.quantile(grey, 0.995)), 1e-6)
    shown = (255 * np.clip(grey / bright, 0.0, 1.0) ** (1 / 2.2)).astype(np.uint8)
    large = cv2.resize(shown, None, fx=_LARGER, fy=_LARGER, interpolation=cv2.INTER_CUBIC)
    keys, found = cv2.SIFT_create(2000, contrastThreshold=0.01).detectAndCompute(large, None)  # type: ignore[attr-defined]
    if found is None or not keys:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    points = (np.array([key.pt for key in keys]) + 0.5) / _LARGER - 0.5
    return points, np.sqrt(found / np.maximum(found.sum(1, keepdims=True), 1e-6)).astype(np.float32)


def _by_features(points: np.ndarray, descriptors: np.ndarray, camera: Camera, known: list[Features]) -> list[tuple[np.ndarray, int]]:
    """Guesses of the pose and how many features agree: by the training frames that share most, together, then by each alone."""
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    agreed = []
    for one in known:
        if len(descriptors) < 2 or len(one.descriptors) < 2:
            continue
        pairs = matcher.knnMatch(descriptors, one.descriptors, k=2)
        good = [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < _RATIO * b.distance]
        if good:
            index = np.array(good)
            agreed.append((index[:, 0], one.places[index[:, 1]]))
    agreed.sort(key=lambda pair: -len(pair[0]))
    groups = [agreed[:_NEIGHBOURS], *([pair] for pair in agreed[:_NEIGHBOURS])] if agreed else []
    found = [_by_points(points, camera, group) for group in groups]
    first, alone = found[:1], sorted(found[1:], key=lambda guess: -guess[1])
    return [(pose, count) for pose, count in first + alone if pose is not None and count >= _LEAST_GUESS]


def _by_points(points: np.ndarray, camera: Camera, group: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray | None, int]:
    """PnP with RANSAC, of features (their numbers) and places."""
    which, places = (np.concatenate(parts) for parts in zip(*group, strict=True))
    rays, valid = unproject(points[which], camera)
    valid &= rays[:, 2] > 0.1  # PnP is for points before the camera
    ideal, places = (rays[:, :2] / rays[:, 2:])[valid], places[valid]
    if len(places) < _LEAST_GUESS:
        return None, len(places)
    cv2.setRNGSeed(0)
    limit = _RANSAC_PX / (0.5 * (camera.fx + camera.fy))
    found, turn, shift, inliers = cv2.solvePnPRansac(
        places, ideal, np.eye(3), None, iterationsCount=2000, reprojectionError=limit, confidence=0.9999, flags=cv2.SOLVEPNP_EPNP
    )
    if not found or inliers is None or len(inliers) < _LEAST_GUESS:
        return None, 0 if inliers is None else len(inliers)
    chosen = inliers[:, 0]
    turn, shift = cv2.solvePnPRefineLM(places[chosen], ideal[chosen], np.eye(3), None, turn, shift)
    rotation = cv2.Rodrigues(turn)[0]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ shift[:, 0]
    return pose, len(chosen)


def _refined(field: Field, raw: np.ndarray, camera: Camera, pose: np.ndarray, source: str, inliers: int) -> Registered:
    sensor = field.sensors[source]
    rays, valid = ray_map(camera)
    random = np.random.default_rng(0)
    places = np.argwhere(valid)
    places = places[random.permutation(len(places))[:_RAYS]]
    v, u = places.T
    index = np.zeros(len(v), np.int64) if sensor.mosaic is None else channel_map(sensor.mosaic, camera.height, camera.width)[v, u]
    # of frames with all channels at every pixel, one at random
    index = random.integers(sensor.channel_count, size=len(v)) if sensor.mosaic is None and sensor.channel_count > 1 else index
    seen = raw[v, u].astype(np.float64) if raw.ndim == 2 else raw[v, u, index].astype(np.float64)
    used = seen < sensor.saturation
    v, u, index, seen = v[used], u[used], index[used], seen[used]
    scale = 1.0 / np.sqrt(np.maximum(seen, 0.0) + 0.02)
    local = rays[v, u]

    def rendered(at: np.ndarray) -> np.ndarray:
        return field.cast(local, at, [source], False)[source][np.arange(len(v)), index].astype(np.float64)

    def judged(light: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, float]:
        lit = light > 0.02
        # plainly the median: where the guess is off and the light by 20 %, so is the exposure by 0.5 %; weighted by light, by 4 %
        exposure = float(np.median(seen[lit] / light[lit])) if lit.sum() > 16 else 1.0
        residual = (seen - exposure * light) * scale
        weight = 1.0 / np.maximum(1.0, np.abs(residual) / _HUBER)
        return float((weight * residual**2).sum()), residual, weight, exposure

    # half a pixel of turning, and of moving as far off as the region is
    distance = max(float(np.linalg.norm(pose[:3, 3] - np.array(field.region.centre))), 0.1 * field.region.radius)
    half = 0.5 / (0.5 * (camera.fx + camera.fy))
    unit = np.array([half] * 3 + [half * distance] * 3)
    cost, residual, weight, exposure = judged(rendered(pose))
    damping, normal = 1e-3, np.eye(6)
    for _ in range(_STEPS):
        columns = []
        for k in range(6):
            ahead, behind = (rendered(pose @ motion_to_matrix((sign * unit * np.eye(6)[k])[None])[0]) for sign in (1.0, -1.0))
            columns.append(-exposure * (ahead - behind) / 2.0 * scale)
        slope = np.stack(columns, 1)
        normal = (slope * weight[:, None]).T @ slope
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), (slope * weight[:, None]).T @ residual)
        moved = pose @ motion_to_matrix((step * unit)[None])[0]
        other = judged(rendered(moved))
        if other[0] < cost:
            small = float(np.abs(step).max()) < 0.02
            pose, (cost, residual, weight, exposure), damping = moved, other, max(damping / 5.0, 1e-6)
            if small:
                break
        else:
            damping *= 10.0
            if damping > 10.0:
                break
    in_steps = _sandwich(slope, weight * residual, normal, v // _BLOCK, u // _BLOCK)
    light = (seen - residual / scale) / exposure
    return Registered(
        pose=pose,
        covariance=unit[:, None] * in_steps * unit,
        sd_px=_displacement(in_steps, unit, local * distance, camera),
        inliers=inliers,
        exposure=exposure,
        residual=float(np.sqrt(np.mean((residual / scale) ** 2)) / max(float(np.mean(exposure * light)), 1e-6)),
    )


def _sandwich(slope: np.ndarray, pull: np.ndarray, normal: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Covariance (6, 6) of a least squares solution whose errors go together within blocks of the picture and not across them (the
    cluster-robust sandwich of Liang and Zeger, Biometrika 1986): N⁻¹ (Σ_b g_b g_bᵀ) N⁻¹ with g_b = Σ_{i in b} slope_i pull_i."""
    block = row * (int(column.max(initial=0)) + 1) + column
    sums = np.stack([np.bincount(block, weights=slope[:, k] * pull) for k in range(6)], 1)
    blocks = len(np.unique(block))
    inverse = np.linalg.pinv(normal)
    return inverse @ (sums.T @ sums) @ inverse * blocks / max(blocks - 6.0, 1.0)


def _displacement(covariance: np.ndarray, unit: np.ndarray, points: np.ndarray, camera: Camera) -> float:
    """Root mean square [px] by which points (N, 3) of the camera's axes move in the picture, of a motion (in units) of this covariance."""
    before = project(points, camera)
    moves = []
    for k in range(6):
        back = np.linalg.inv(motion_to_matrix((unit * np.eye(6)[k])[None])[0])
        moves.append(project(points @ back[:3, :3].T + back[:3, 3], camera) - before)
    slope = np.stack(moves, -1)  # (N, 2, 6)
    square = np.einsum("nik,kl,nil->n", slope, covariance, slope)
    return float(np.sqrt(max(float(np.nanmean(square)), 0.0)))
