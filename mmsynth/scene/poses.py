"""Poses and intrinsics as files spell them, converted to the library's conventions.

Out of here comes ``camera_to_world``: (4, 4) float64, rigid, OpenCV axes (x right, y down, z forward), in the file's world
frame and unit, and ``Camera`` with the centre of the top-left pixel at (0, 0). COLMAP and nerfstudio put that centre at
(0.5, 0.5), so their principal points move by -0.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json
from mmsynth.scene.images import read_native
from mmsynth.scene.scene import Region
from mmsynth.sensors.camera import Camera, Lens

Pose = tuple[Camera | None, np.ndarray, str]
"""camera (None where the file has no intrinsics), camera_to_world (4, 4), name."""

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""camera_to_world in OpenGL axes (y up, z back) times this = in OpenCV axes."""

# --- checks ----------------------------------------------------------------------------------------------------------


def number(entry: Mapping[str, Any], key: str, where: str) -> float:
    """``entry[key]`` as a finite float, or an InputError that names ``where`` (file and place) and the key."""
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise InputError(f"{where}: key '{key}' is {'missing' if key not in entry else repr(value)}, expected a finite number.")
    return float(value)


def whole(entry: Mapping[str, Any], key: str, where: str) -> int:
    """``entry[key]`` as an int (1080.0 is accepted), or an InputError."""
    value = number(entry, key, where)
    if value != int(value):
        raise InputError(f"{where}: key '{key}' is {value}, expected a whole number.")
    return int(value)


def rigid(matrix: Any, where: str, tolerance: float = 1e-4) -> np.ndarray:
    """Check that a 3x4 or 4x4 matrix is a rigid motion, and remove its rounding errors.

    Args:
        matrix: nested lists or array. where: file and place, for the message.
        tolerance: largest accepted entry of |R Rᵀ - 1|; errors below it are removed by taking the nearest rotation (SVD).
    Returns:
        (4, 4) float64.
    Raises:
        InputError: wrong shape, NaN, scale, shear, reflection, or a last row other than 0 0 0 1.
    """
    if matrix is None:
        raise InputError(f"{where}: the camera-to-world matrix is missing, expected 4x4 or 3x4.")
    try:
        pose = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: the pose is not a matrix of numbers, expected 4x4 or 3x4.") from error
    if pose.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{where}: the pose has the shape {pose.shape}, expected 4x4 or 3x4.")
    if not np.isfinite(pose).all():
        row, column = np.argwhere(~np.isfinite(pose))[0]
        raise InputError(f"{where}: the pose is not finite in row {row}, column {column}, expected a rigid camera-to-world matrix.")
    if pose.shape == (4, 4) and np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > tolerance:
        raise InputError(f"{where}: the last row of the pose is {pose[3].tolist()}, expected 0 0 0 1.")
    rotation = pose[:3, :3]
    error_size = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error_size > tolerance:
        raise InputError(f"{where}: the pose is not rigid (R Rᵀ differs from 1 by {error_size:.2g}), expected no scale and no shear.")
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: the pose is a reflection (determinant -1), expected a rotation.")
    u, _, vt = np.linalg.svd(rotation)
    out = np.eye(4)
    out[:3, :3] = u @ vt
    out[:3, 3] = pose[:3, 3]
    return out


# --- where the cameras look ------------------------------------------------------------------------------------------


def region_from_cameras(cameras: Sequence[Camera], poses: Sequence[np.ndarray]) -> Region:
    """Guess the region of interest of a scene that does not state it.

    Centre: the point nearest to all optical axes (least squares). Radius: the ball there that just fills a frame, median over
    the cameras of distance x sin(half the larger field of view), but at most 0.9 of the distance to the nearest camera, so
    that cameras stay outside; a stray camera nearer than 1/9 of the median does not shrink it further.

    Where the axes have no common point in front of most cameras (one camera, parallel axes, looking outwards), the ball is
    put ahead of the cameras' mean position, along their mean direction, at twice their spread (1 unit for a single
    position), and fills a frame as above. Without a mean direction it is around the cameras' mean position: cameras that face
    each other see it as above, a panorama is inside a ball of twice its spread.

    Args:
        cameras, poses: one per frame; poses (4, 4), OpenCV axes.
    Returns:
        a finite ball with positive radius, in the poses' frame and unit.
    """
    centres = np.stack([pose[:3, 3] for pose in poses])
    axes = np.stack([pose[:3, 2] for pose in poses])
    half_view = np.array([_half_view(camera) for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # (N, 3, 3): removes the part along each axis
    normal = across.mean(0)
    # smallest eigenvalue = mean squared sine between the axes and their common direction: 1e-4 is about half a degree
    if np.linalg.eigvalsh(normal)[0] > 1e-4:
        # solved about the mean position: worlds far from their origin (survey coordinates) keep their digits
        mean = centres.mean(0)
        point = mean + np.linalg.solve(normal, np.einsum("nij,nj->i", across, centres - mean) / len(centres))
        if _before(point, centres, axes):
            return _filling(point, centres, half_view)
    mean = centres.mean(0)
    reach = 2 * float(np.linalg.norm(centres - mean, axis=1).max())
    reach = reach if reach > 1e-9 * max(1.0, float(np.linalg.norm(mean))) else 1.0  # one position up to rounding
    direction = axes.mean(0)
    length = float(np.linalg.norm(direction))
    if length < 0.5:
        # cameras that face each other along one line, or a panorama
        return _filling(mean, centres, half_view) if _before(mean, centres, axes) else Region(_triple(mean), reach)
    return Region(_triple(mean + reach * direction / length), reach * float(np.sin(np.median(half_view))))


def _before(point: np.ndarray, centres: np.ndarray, axes: np.ndarray) -> bool:
    """Whether it lies in front of most cameras."""
    return bool(np.mean(np.einsum("ni,ni->n", point - centres, axes) > 0) > 0.5)


def _filling(point: np.ndarray, centres: np.ndarray, half_view: np.ndarray) -> Region:
    """The ball around a point that just fills the frame of a typical camera, and leaves the cameras outside."""
    distance = np.linalg.norm(centres - point, axis=1)
    radius = min(float(np.median(distance * np.sin(half_view))), 0.9 * max(float(distance.min()), float(np.median(distance)) / 9))
    return Region(_triple(point), radius)


def region_from_points(points: np.ndarray, seen: Region, positions: np.ndarray) -> Region:
    """A region of interest that fits what is there: the ball around the sparse points that cameras look at.

    Centre: the median of the points within the region that the cameras gave. Radius: 1.1 times the distance within which 95 % of
    them lie, and as far as the cameras' region allows: not larger than it, and cameras that were outside stay outside.

    Args:
        points: (N, 3), of structure from motion. seen: ``region_from_cameras``. positions: (M, 3) of the cameras.
    Returns:
        ``seen`` where fewer than 50 points lie in it.
    """
    centre = np.asarray(seen.centre)
    inside = points[np.linalg.norm(points - centre, axis=1) <= seen.radius]
    if len(inside) < 50:
        return seen
    middle = np.median(inside, axis=0)
    reach = 1.1 * float(np.quantile(np.linalg.norm(inside - middle, axis=1), 0.95))
    outside = positions[np.linalg.norm(positions - centre, axis=1) > seen.radius]
    room = 0.9 * float(np.linalg.norm(outside - middle, axis=1).min()) if len(outside) else reach
    radius = min(reach, seen.radius, room)
    return Region(_triple(middle), radius) if radius > 0 else seen


def _half_view(camera: Camera) -> float:
    """Half the larger field of view, in radians."""
    return float(np.arctan(max(camera.width / camera.fx, camera.height / camera.fy) / 2))


def _triple(point: np.ndarray) -> tuple[float, float, float]:
    return float(point[0]), float(point[1]), float(point[2])


# --- nerfstudio's transforms.json ------------------------------------------------------------------------------------

_BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("k1", "k2", "k3", "k4")
_BROWN_MODELS = ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE_MODEL = "OPENCV_FISHEYE"


def transforms_camera(
    shared: Mapping[str, Any], frame: Mapping[str, Any], where: str, size: tuple[int, int] | None = None
) -> Camera | None:
    """Intrinsics of one frame of transforms.json; a key of the frame wins over the shared one.

    Distortion k1..k6, p1, p2 is read as OpenCV's rational Brown model, k1..k4 of an ``OPENCV_FISHEYE`` (or ``is_fisheye``) as
    Kannala-Brandt's. Keys that are missing: coefficients = 0, cx, cy = image centre, fl_y = fl_x, and fl_x, fl_y from
    camera_angle_x, camera_angle_y [rad].

    Args:
        size: width, height of the image for files without w and h.
    Returns:
        None when there is neither a focal length nor an angle, or no size.
    Raises:
        InputError: bad number, or another lens model.
    """
    merged = {**shared, **frame}
    model = str(merged.get("camera_model", "OPENCV")).upper()
    fisheye = model == _FISHEYE_MODEL or (model in _BROWN_MODELS and bool(merged.get("is_fisheye")))
    if model not in _BROWN_MODELS and not fisheye:
        raise InputError(f"{where}: camera_model {model} is not supported, expected one of {' '.join((*_BROWN_MODELS, _FISHEYE_MODEL))}.")
    if "w" in merged and "h" in merged:
        size = whole(merged, "w", where), whole(merged, "h", where)
    if size is None:
        return None
    width, height = size
    # the innermost place that says anything about the focal length decides
    source = frame if any(key in frame for key in ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")) else shared
    fx, fy = _focal(source, "x", width, where), _focal(source, "y", height, where)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        return None
    cx = number(merged, "cx", where) if "cx" in merged else width / 2
    cy = number(merged, "cy", where) if "cy" in merged else height / 2
    distortion = [number(merged, key, where) if key in merged else 0.0 for key in (_FISHEYE if fisheye else _BROWN)]
    return make_camera(where, width, height, fx, fy, cx - 0.5, cy - 0.5, distortion, fisheye)


def _focal(entry: Mapping[str, Any], axis: str, pixels: int, where: str) -> float | None:
    if f"fl_{axis}" in entry:
        return number(entry, f"fl_{axis}", where)
    if f"camera_angle_{axis}" in entry:
        angle = number(entry, f"camera_angle_{axis}", where)
        if not 0 < angle < np.pi:
            raise InputError(f"{where}: key 'camera_angle_{axis}' is {angle}, expected an angle between 0 and pi radians.")
        return float(pixels / 2 / np.tan(angle / 2))
    return None


def make_camera(
    where: str, width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: Sequence[float], fisheye: bool = False
) -> Camera:
    """A Camera whose errors name the file; no coefficients when all are zero, so that equal cameras compare equal."""
    try:
        lens: Lens = "kannala_brandt" if fisheye else "brown_conrady"
        return Camera(width, height, fx, fy, cx, cy, tuple(distortion) if any(distortion) else (), lens)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


# --- poses files -----------------------------------------------------------------------------------------------------


def read_poses(path: Path) -> list[Pose]:
    """Read the poses to render from, in file order.

    Accepted:

    * nerfstudio ``transforms.json`` (OpenGL axes);
    * nerfstudio ``camera_path.json`` (OpenGL axes, vertical field of view in degrees, square pixels, no distortion; its poses are
      taken to be in the scene's frame);
    * MMS-DATA ``meta_data.json``: the poses of its first modality, in the frame and unit in which the scene is read;
    * COLMAP ``images.txt`` (with ``cameras.txt`` beside it if there), or a folder that holds it;
    * TUM, ``.tum`` or ``.txt``: lines ``t tx ty tz qx qy qz qw``, camera to world, OpenCV axes; no intrinsics. The name of a pose is
      its time as the file spells it. A ``.txt`` of another name than ``images.txt`` is TUM when its first line has at most eight values;
    * ``{"convention": "OpenCV ...", "rig": [4x4, ...]}`` (OpenCV axes).

    Raises:
        InputError: missing or unknown file, no pose in it, or a pose that is not finite and rigid.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "images.txt"
    if _is_tum(path):
        poses = _read_tum(path)
    elif path.suffix.lower() == ".txt":
        poses = _read_colmap(path)
    else:
        content = read_json(path)
        if not isinstance(content, dict):
            kind = type(content).__name__
            raise InputError(f"{path}: a JSON {kind}, expected an object with 'frames', 'camera_path', 'modalities' or 'rig'.")
        if "frames" in content:
            poses = _read_transforms(content, path)
        elif "camera_path" in content:
            poses = _read_camera_path(content, path)
        elif "modalities" in content:
            from mmsynth.scene.layouts.mmsdata import read_reference_poses  # which is built on this module

            poses = [*read_reference_poses(path)]
        elif "rig" in content:
            poses = _read_rig(content, path)
        else:
            raise InputError(f"{path}: none of the keys 'frames' (transforms.json), 'camera_path', 'modalities' (MMS-DATA) or 'rig' found.")
    if not poses:
        raise InputError(f"{path}: no poses in it, expected at least one.")
    return poses


def entries(content: Mapping[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    """``content[key]`` as a list of objects, or an InputError."""
    value = content.get(key)
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise InputError(f"{path}: key '{key}' is not a list of objects.")
    return value


def _read_transforms(content: Mapping[str, Any], path: Path) -> list[Pose]:
    out: list[Pose] = []
    for index, frame in enumerate(entries(content, "frames", path)):
        where = f"{path}: frame {index}"
        name = str(frame.get("file_path", f"{index:04d}"))
        image = path.parent / name
        size = None
        if not {"w", "h"} <= {**content, **frame}.keys() and image.is_file():
            height, width = read_native(image).shape[:2]
            size = width, height
        pose = rigid(frame.get("transform_matrix"), where) @ OPENGL_TO_OPENCV
        out.append((transforms_camera(content, frame, where, size), pose, Path(name).stem))
    return out


def _read_camera_path(content: Mapping[str, Any], path: Path) -> list[Pose]:
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise InputError(f"{path}: camera_type '{kind}' is not supported yet, expected 'perspective'.")
    out: list[Pose] = []
    for index, entry in enumerate(entries(content, "camera_path", path)):
        where = f"{path}: camera {index}"
        try:
            matrix = np.asarray(entry.get("camera_to_world"), dtype=np.float64).reshape(4, 4)
        except (TypeError, ValueError) as error:
            raise InputError(f"{where}: key 'camera_to_world' does not hold 16 numbers.") from error
        camera = None
        if "render_width" in content and "render_height" in content and "fov" in entry:
            width, height = whole(content, "render_width", str(path)), whole(content, "render_height", str(path))
            fov = number(entry, "fov", where)
            if not 0 < fov < 180:
                raise InputError(f"{where}: key 'fov' is {fov}, expected between 0 and 180 degrees.")
            focal = float(height / 2 / np.tan(np.radians(fov) / 2))
            camera = make_camera(where, width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5, ())
        out.append((camera, rigid(matrix, where) @ OPENGL_TO_OPENCV, f"{index:04d}"))
    return out


def _read_rig(content: Mapping[str, Any], path: Path) -> list[Pose]:
    convention = str(content.get("convention", "OpenCV"))
    if "opencv" not in convention.lower():
        raise InputError(f"{path}: key 'convention' is '{convention}', expected OpenCV axes (x right, y down, z forward).")
    if not isinstance(content["rig"], list):
        raise InputError(f"{path}: key 'rig' is not a list of 4x4 matrices.")
    return [(None, rigid(matrix, f"{path}: pose {index}"), f"{index:04d}") for index, matrix in enumerate(content["rig"])]


# --- TUM trajectories -------------------------------------------------------------------------------------------------

_TUM_LINE = "t tx ty tz qx qy qz qw"


def _is_tum(path: Path) -> bool:
    """By its name, else by its first line: images of COLMAP have ten values or more."""
    if path.suffix.lower() == ".tum":
        return True
    if path.suffix.lower() != ".txt" or path.name.lower() == "images.txt":
        return False
    content = (line.split() for line in text_lines(path))
    return len(next((tokens for tokens in content if tokens and not tokens[0].startswith("#")), [])) <= 8


def _read_tum(path: Path) -> list[Pose]:
    out: list[Pose] = []
    for row, line in enumerate(text_lines(path), 1):
        tokens = line.split()
        if not tokens or line.lstrip().startswith("#"):
            continue
        where = f"{path}: line {row}"
        if len(tokens) != 8:
            raise InputError(f"{where}: {len(tokens)} values, expected '{_TUM_LINE}'.")
        values = _floats(tokens, where, _TUM_LINE)
        pose = np.eye(4)
        pose[:3, :3] = _rotation(_unit(values[[7, 4, 5, 6]], where))
        pose[:3, 3] = values[1:4]
        out.append((None, pose, tokens[0]))
    return out


def _floats(tokens: Sequence[str], where: str, line: str) -> np.ndarray:
    """Finite numbers of a text line, or an InputError that says what the line should hold."""
    try:
        values = np.array([float(token) for token in tokens])
    except ValueError as error:
        raise InputError(f"{where}: not a number, expected '{line}'.") from error
    if not np.isfinite(values).all():
        raise InputError(f"{where}: a value is not finite, expected '{line}'.")
    return values


def _unit(quaternion: np.ndarray, where: str) -> np.ndarray:
    """A unit quaternion without the rounding of its decimals."""
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 1e-3:
        raise InputError(f"{where}: the quaternion has the length {norm:.4g}, expected a unit quaternion.")
    return quaternion / norm


# --- COLMAP text model -----------------------------------------------------------------------------------------------

_COLMAP_LINE = "id qw qx qy qz tx ty tz camera name"
# what each parameter of a COLMAP camera model is, in file order
_COLMAP_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    _FISHEYE_MODEL: "fx fy cx cy k1 k2 k3 k4",
}


def _read_colmap(path: Path) -> list[Pose]:
    """images.txt: every image takes two lines, ``id qw qx qy qz tx ty tz camera name`` (world to camera) and its 2-D points."""
    cameras = _colmap_cameras(path.with_name("cameras.txt"))
    out: list[Pose] = []
    points_expected = False
    for row, line in enumerate(text_lines(path), 1):
        tokens = line.split()
        # a points line holds triples and may be empty or, in some files, left out; an image line never has 3 n tokens
        # unless the name has spaces, and then it comes where no points line is expected
        if points_expected and len(tokens) % 3 == 0 and not line.startswith("#"):
            points_expected = False
            continue
        if not tokens or line.startswith("#"):
            continue
        where = f"{path}: line {row}"
        if len(tokens) < 10:
            raise InputError(f"{where}: {len(tokens)} values, expected '{_COLMAP_LINE}'.")
        values = _floats(tokens[1:8], where, _COLMAP_LINE)
        if not tokens[8].isdecimal():
            raise InputError(f"{where}: camera {tokens[8]} is not a whole number, expected '{_COLMAP_LINE}'.")
        camera_id = int(tokens[8])
        if cameras is not None and camera_id not in cameras:
            raise InputError(f"{where}: camera {camera_id} is not in {path.with_name('cameras.txt')}.")
        camera_to_world = np.eye(4)
        camera_to_world[:3, :3] = _rotation(_unit(values[:4], where)).T
        camera_to_world[:3, 3] = -camera_to_world[:3, :3] @ values[4:7]
        out.append((cameras[camera_id] if cameras is not None else None, camera_to_world, Path(" ".join(tokens[9:])).stem))
        points_expected = True
    return out


def _colmap_cameras(path: Path) -> dict[int, Camera] | None:
    if not path.is_file():
        return None
    out: dict[int, Camera] = {}
    for row, line in enumerate(text_lines(path), 1):
        tokens = line.split()
        if not tokens or line.startswith("#"):
            continue
        where = f"{path}: line {row}"
        if len(tokens) < 4 or tokens[1] not in _COLMAP_MODELS:
            models = " ".join(_COLMAP_MODELS)
            raise InputError(f"{where}: unsupported camera, expected 'id model width height ...' with one of the models {models}.")
        names = _COLMAP_MODELS[tokens[1]].split()
        try:
            identity, width, height = int(tokens[0]), int(tokens[2]), int(tokens[3])
            value = dict(zip(names, map(float, tokens[4:]), strict=True))
        except ValueError as error:
            raise InputError(f"{where}: expected {len(names)} numbers ({' '.join(names)}) after the size.") from error
        fisheye = tokens[1] == _FISHEYE_MODEL
        distortion = [value.get(key, 0.0) for key in (_FISHEYE if fisheye else _BROWN)]
        fx, fy = value.get("fx", value.get("f", 0.0)), value.get("fy", value.get("f", 0.0))
        out[identity] = make_camera(where, width, height, fx, fy, value["cx"] - 0.5, value["cy"] - 0.5, distortion, fisheye)
    return out


def text_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").split("\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text at byte {error.start}.") from error
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror or error}).") from error


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z) → (3, 3) rotation."""
    w, x, y, z = quaternion
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
