"""Structure from motion by COLMAP: the one module that knows pycolmap (``pip install 'mmsynth[capture]'``).

Poses come from grey pictures (``matching_picture``) by SIFT, pairwise matching, and incremental mapping. Seeds are fixed, mapping runs in
one thread, and what runs in two is done picture by picture: the same pictures give the same poses.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap: loaded after it, its PNG writer finds pycolmap's zlib and crashes
import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.capture.likely_pairs import likely_pairs
from mmsynth.sensors.camera import Camera, project

_THREADS = 2
_FEATURES = 4096  # in a picture at the most
_LARGE = 1000  # pixels a side above which the finest octave of SIFT, of a picture made twice as large, is left out
_LARGEST = 2000  # pixels a side at which pictures are searched at the most
_LINKS = 8  # views with the most matches in the reference sensor: there other sensors are matched
_FEW = 50  # points in a picture that shows no texture
_WELL_SEEN = 10  # pictures of a camera from which its principal point is found, too

Shot = tuple[str, int]
"""Sensor and view."""


@dataclass(frozen=True)
class Picture:
    """A picture for matching.

    Attributes:
        file: its path below the folder of pictures, ``<sensor>/<view>.png``: equal names are one instant.
        camera: its camera as calibrated, or as first guessed.
        known: the camera is calibrated and stays. prior: a guessed focal length is from the file's own data (EXIF).
    """

    sensor: str
    view: int
    file: str
    camera: Camera
    known: bool = False
    prior: bool = False

    @property
    def shot(self) -> Shot:
        return self.sensor, self.view


@dataclass(frozen=True)
class Registered:
    """A picture with its pose: camera_to_world (4, 4); how many points it sees, and their root mean square reprojection error [px]."""

    camera: Camera
    camera_to_world: np.ndarray
    points: int
    error: float


@dataclass(frozen=True)
class Structure:
    """What structure from motion found, in a frame and unit of its own, or those of the rig.

    Attributes:
        registered: by sensor and view. lost: why others are not.
        points: (N, 3); errors: (N,) px, their mean reprojection error.
        places: (4, 4) camera to reference by sensor, where there is a rig. notes: one sentence for each thing to be said.
        model: the pycolmap Reconstruction.
    """

    registered: dict[Shot, Registered]
    lost: dict[Shot, str]
    points: np.ndarray
    errors: np.ndarray
    places: dict[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    model: Any = None


def load_pycolmap() -> Any:
    """The library, silenced, with its seed set. Raises InputError where it is missing."""
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            "pose: structure from motion needs pycolmap, expected it to be installed: pip install 'mmsynth[capture]'."
        ) from error
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(0)
    return pycolmap


def focal_length_of(path: Path) -> float | None:
    """The focal length that a photograph states of itself (EXIF), over its longer side; None where it states none."""
    pycolmap = load_pycolmap()
    try:
        camera = pycolmap.infer_camera_from_image(path)
    except Exception:  # not a format that it reads
        return None
    return float(camera.mean_focal_length() / max(camera.width, camera.height)) if camera.has_prior_focal_length else None


def reconstruct(
    folder: Path, work: Path, pictures: Sequence[Picture], rig: Mapping[str, np.ndarray] | None = None, where: str = "pose"
) -> Structure:
    """Find where pictures were taken.

    Args:
        folder: of the pictures' files. work: an empty folder for COLMAP's own.
        pictures: of one sensor or several; the first one's sensor is the reference.
        rig: camera to reference (4, 4) by sensor, of all of them: one pose is found for each instant, and the unit is the rig's.
            None: every picture has a pose of its own.
        where: what errors begin with.
    Raises:
        InputError: no pycolmap, no texture, no matches, or no start with parallax.
    """
    pycolmap = load_pycolmap()
    database = work / "database.db"
    ids = _import(pycolmap, database, folder, pictures)
    _extract(pycolmap, database, folder, pictures)
    counts = _features(pycolmap, database, ids)
    if sum(count >= _FEW for count in counts.values()) < 2:
        raise InputError(f"{where}: no texture, {max(counts.values())} points at the most were found in a picture, expected some hundred.")
    if rig is not None:
        _apply_rig(pycolmap, database, rig)
    links = _match(pycolmap, database, work, pictures, ids)
    if not links:
        raise InputError(f"{where}: no matches, no two of {len(pictures)} pictures show the same points, expected pictures that overlap.")
    models = _map(pycolmap, database, folder, work, pictures)
    if not models:
        raise InputError(f"{where}: {_why_no_start(pycolmap, database, links)}")
    best = models[0]
    _finish(pycolmap, best, pictures)
    found = _structure(best, pictures, {} if rig is None else rig)
    lost, notes = _left_out(found.registered, pictures, models, counts, links, where)
    return replace(found, lost=lost, notes=(*notes, *_weak(pycolmap, database)))


# --- the database


def _import(pycolmap: Any, database: Path, folder: Path, pictures: Sequence[Picture]) -> dict[Shot, int]:
    """Write cameras and pictures, one camera for equal ones of a sensor; gives the ids of images."""
    groups: dict[tuple[str, Camera], list[Picture]] = defaultdict(list)
    for picture in pictures:
        groups[picture.sensor, picture.camera].append(picture)
    opened = pycolmap.Database.open(database)
    numbers = []
    for group in groups.values():
        camera = _colmap_camera(pycolmap, group[0], len(group))
        camera.has_prior_focal_length = group[0].known or group[0].prior
        numbers.append(opened.write_camera(camera))
    opened.close()
    for number, group in zip(numbers, groups.values(), strict=True):
        options = pycolmap.ImageReaderOptions(existing_camera_id=number)
        pycolmap.import_images(database, folder, pycolmap.CameraMode.AUTO, [picture.file for picture in group], options)
    opened = pycolmap.Database.open(database)
    by_file = {image.name: image.image_id for image in opened.read_all_images()}
    opened.close()
    return {picture.shot: by_file[picture.file] for picture in pictures}


def _colmap_camera(pycolmap: Any, picture: Picture, count: int) -> Any:
    """A camera that few pictures are of gets one coefficient only."""
    camera = picture.camera
    values = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    coefficients = camera.coefficients.tolist()
    if camera.lens == "kannala_brandt":
        model, parameters = "OPENCV_FISHEYE", values + coefficients
    elif any(coefficients[4:]):
        model, parameters = "FULL_OPENCV", values + coefficients
    elif picture.known or count >= _WELL_SEEN:
        model, parameters = "OPENCV", values + coefficients[:4]
    else:
        model, parameters = "SIMPLE_RADIAL", [camera.fx, *values[2:], 0.0]
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=parameters)


def _camera_of(camera: Any) -> Camera:
    """COLMAP's camera in our conventions."""
    p = [float(value) for value in camera.params]
    if camera.model_name == "SIMPLE_RADIAL":
        p = [p[0], p[0], p[1], p[2], p[3], 0.0, 0.0, 0.0]
    lens = "kannala_brandt" if camera.model_name == "OPENCV_FISHEYE" else "brown_conrady"
    distortion = tuple(p[4:]) if any(p[4:]) or lens == "kannala_brandt" else ()
    return Camera(camera.width, camera.height, p[0], p[1], p[2] - 0.5, p[3] - 0.5, distortion, lens)  # type: ignore[arg-type]


def _extract(pycolmap: Any, database: Path, folder: Path, pictures: Sequence[Picture]) -> None:
    large = max(max(p.camera.width, p.camera.height) for p in pictures) > _LARGE
    options = pycolmap.FeatureExtractionOptions(num_threads=_THREADS, use_gpu=False, max_image_size=_LARGEST)
    options.sift.max_num_features = _FEATURES
    options.sift.first_octave = 0 if large else -1
    pycolmap.extract_features(database, folder, [p.file for p in pictures], extraction_options=options, device=pycolmap.Device.cpu)


def _features(pycolmap: Any, database: Path, ids: Mapping[Shot, int]) -> dict[Shot, int]:
    opened = pycolmap.Database.open(database)
    counts = {shot: int(opened.num_keypoints_for_image(number)) for shot, number in ids.items()}
    opened.close()
    return counts


def _apply_rig(pycolmap: Any, database: Path, rig: Mapping[str, np.ndarray]) -> None:
    cameras: list[Any] = []
    for sensor, place in rig.items():
        camera = pycolmap.RigConfigCamera(ref_sensor=not cameras, image_prefix=f"{sensor}/")
        if cameras:
            camera.cam_from_rig = pycolmap.Rigid3d(np.linalg.inv(place)[:3])
        cameras.append(camera)
    opened = pycolmap.Database.open(database)
    pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=cameras)], opened)
    opened.close()


# --- matching


def _match(pycolmap: Any, database: Path, work: Path, pictures: Sequence[Picture], ids: Mapping[Shot, int]) -> dict[tuple[Shot, Shot], int]:
    """Match the reference sensor's pictures, then those of others where the reference's show the same; gives inliers of pairs."""
    by_sensor: dict[str, list[Picture]] = defaultdict(list)
    for picture in pictures:
        by_sensor[picture.sensor].append(picture)
    reference = pictures[0].sensor
    _match_pairs(pycolmap, database, work, _pairs(pycolmap, database, by_sensor[reference], ids))
    links = _inliers(pycolmap, database, ids)
    if len(by_sensor) > 1 and links:
        near: dict[int, set[int]] = defaultdict(set)
        for view in {picture.view for picture in pictures}:
            of_view = sorted(
                ((count, b[1] if a[1] == view else a[1]) for (a, b), count in links.items() if view in (a[1], b[1])), reverse=True
            )
            near[view] = {view} | {other for _, other in of_view[:_LINKS]}
        _match_pairs(pycolmap, database, work, list(_across(pictures, near, reference)))
        links = _inliers(pycolmap, database, ids)
    return links


def _pairs(pycolmap: Any, database: Path, pictures: Sequence[Picture], ids: Mapping[Shot, int]) -> list[tuple[str, str]]:
    """Of one sensor: files that are likely to show the same."""
    opened = pycolmap.Database.open(database)
    descriptors = [np.asarray(opened.read_descriptors(ids[picture.shot]).data) for picture in pictures]
    scales = [_scales(np.asarray(opened.read_keypoints(ids[picture.shot]))) for picture in pictures]
    opened.close()
    return [(pictures[i].file, pictures[j].file) for i, j in likely_pairs(descriptors, scales)]


def _scales(keypoints: np.ndarray) -> np.ndarray:
    """Of keypoints as rows x, y and the four numbers of an affine shape."""
    return np.asarray(np.sqrt(np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])))


def _across(pictures: Sequence[Picture], near: Mapping[int, set[int]], reference: str) -> Iterable[tuple[str, str]]:
    """Pairs of pictures of views that see the same, but for the reference's own."""
    for i, a in enumerate(pictures):
        for b in pictures[i + 1 :]:
            if (a.sensor != reference or b.sensor != reference) and (b.view in near[a.view] or a.view in near[b.view]):
                yield a.file, b.file


def _match_pairs(pycolmap: Any, database: Path, work: Path, pairs: Sequence[tuple[str, str]]) -> None:
    listed = work / "pairs.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    matching = pycolmap.FeatureMatchingOptions(num_threads=_THREADS, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.match_image_pairs(
        database, matching, pycolmap.ImportedPairingOptions(match_list_path=listed), verification, device=pycolmap.Device.cpu
    )


def _inliers(pycolmap: Any, database: Path, ids: Mapping[Shot, int]) -> dict[tuple[Shot, Shot], int]:
    shots = {number: shot for shot, number in ids.items()}
    opened = pycolmap.Database.open(database)
    pairs, counts = opened.read_two_view_geometry_num_inliers()
    opened.close()
    out = {}
    for pair, count in zip(pairs, counts, strict=True):
        a, b = pair if isinstance(pair, tuple) else pycolmap.pair_id_to_image_pair(pair)
        if count >= pycolmap.TwoViewGeometryOptions().min_num_inliers:
            out[shots[a], shots[b]] = int(count)
    return out


# --- mapping


def _map(pycolmap: Any, database: Path, folder: Path, work: Path, pictures: Sequence[Picture]) -> list[Any]:
    """Reconstructions, the largest first. Thresholds made for megapixels are eased where they leave out more than a tenth."""
    known = all(picture.known for picture in pictures)
    best: list[Any] = []
    for eased in (False, True):
        options = pycolmap.IncrementalPipelineOptions(
            num_threads=1, random_seed=0, min_model_size=3, extract_colors=False, ba_refine_focal_length=not known,
            ba_refine_extra_params=not known, ba_refine_sensor_from_rig=False,
        )  # fmt: skip
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = not known
        opened = pycolmap.Database.open(database)
        fixed = {p.file for p in pictures if p.known}
        options.constant_cameras = {image.camera_id for image in opened.read_all_images() if image.name in fixed}
        opened.close()
        if eased:
            options.mapper.init_min_num_inliers = 30
            options.mapper.init_min_tri_angle = 6.0
            options.mapper.abs_pose_min_num_inliers = 15
        out = work / f"models_{int(eased)}"
        out.mkdir()
        found = pycolmap.incremental_mapping(database, folder, out, options)
        models = sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
        if models and (not best or models[0].num_reg_images() > best[0].num_reg_images()):
            best = models
        if best and best[0].num_reg_images() >= 0.9 * len(pictures):
            break
    return best


def _finish(pycolmap: Any, model: Any, pictures: Sequence[Picture]) -> None:
    """One adjustment of everything, with the principal points of cameras that many pictures are of."""
    if all(picture.known for picture in pictures):
        return
    of_camera: dict[int, int] = defaultdict(int)
    for image in model.images.values():
        of_camera[image.camera_id] += image.has_pose
    if min(count for count in of_camera.values() if count) < _WELL_SEEN:
        return
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, refine_sensor_from_rig=False, print_summary=False)
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)


# --- what was found


def _structure(model: Any, pictures: Sequence[Picture], rig: Mapping[str, np.ndarray]) -> Structure:
    shots = {picture.file: picture for picture in pictures}
    registered = {}
    model.update_point_3d_errors()
    for image in model.images.values():
        if not image.has_pose:
            continue
        picture = shots[image.name]
        camera = picture.camera if picture.known else _camera_of(model.cameras[image.camera_id])
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        seen = [point for point in image.points2D if point.has_point3D()]
        error = 0.0
        if seen:
            at = np.array([model.points3D[point.point3D_id].xyz for point in seen]) @ pose[:3, :3].T + pose[:3, 3]
            apart = project(at, camera) - (np.array([point.xy for point in seen]) - 0.5)
            error = float(np.sqrt(np.nanmean((apart**2).sum(-1))))
        registered[picture.shot] = Registered(camera, np.linalg.inv(pose), len(seen), error)
    order = {picture.shot: i for i, picture in enumerate(pictures)}
    registered = dict(sorted(registered.items(), key=lambda item: order[item[0]]))
    points = [model.points3D[number] for number in sorted(model.points3D)]
    positions = np.array([point.xyz for point in points]).reshape(-1, 3)
    return Structure(registered, {}, positions, np.array([point.error for point in points]), dict(rig), (), model)


def _left_out(
    registered: Mapping[Shot, Registered],
    pictures: Sequence[Picture],
    models: Sequence[Any],
    counts: Mapping[Shot, int],
    links: Mapping[tuple[Shot, Shot], int],
    where: str,
) -> tuple[dict[Shot, str], list[str]]:
    """Why pictures have no pose, and what is to be said of reconstructions that do not hang together."""
    elsewhere = {image.name for model in models[1:] for image in model.images.values() if image.has_pose}
    linked = {shot for pair in links for shot in pair}
    lost = {}
    for picture in pictures:
        shot = picture.shot
        if shot in registered:
            continue
        if counts[shot] < _FEW:
            lost[shot] = f"no texture: {counts[shot]} points in it"
        elif shot not in linked:
            lost[shot] = "no matches with any other picture"
        elif picture.file in elsewhere:
            lost[shot] = "in another reconstruction, which has no connection to the one that was taken"
        else:
            lost[shot] = "its matches do not agree with the poses of the others"
    apart = [picture.shot for picture in pictures if picture.shot in lost and picture.file in elsewhere]
    if not apart:
        return lost, []
    sizes = " and ".join(str(model.num_reg_images()) for model in models)
    return lost, [f"{where}: {len(models)} disconnected reconstructions, of {sizes} pictures; the largest is taken."]


def _geometries(pycolmap: Any, database: Path) -> list[Any]:
    opened = pycolmap.Database.open(database)
    found = opened.read_two_view_geometries()[1]
    opened.close()
    return [geometry for geometry in found if len(geometry.inlier_matches)]


def _why_no_start(pycolmap: Any, database: Path, links: Mapping[tuple[Shot, Shot], int]) -> str:
    kinds = pycolmap.TwoViewGeometryConfiguration
    flat = (kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC, kinds.PLANAR)
    geometries = _geometries(pycolmap, database)
    if geometries and sum(geometry.config in flat for geometry in geometries) > 0.5 * len(geometries):
        return (
            "no parallax, a homography explains the pictures: the camera only turned, or all that it saw is one plane; "
            "expected a camera that moves sideways before something that has depth."
        )
    return f"no two pictures to start from: {len(links)} pairs match, but not with enough parallax, expected a camera that moves sideways."


def _weak(pycolmap: Any, database: Path) -> list[str]:
    kinds = pycolmap.TwoViewGeometryConfiguration
    geometries = _geometries(pycolmap, database)
    flat = sum(geometry.config in (kinds.PLANAR, kinds.PLANAR_OR_PANORAMIC) for geometry in geometries)
    if flat <= 0.8 * len(geometries):
        return []
    return [f"{flat} of {len(geometries)} pairs see one plane alone, from which focal length and depth are hard to tell."]
