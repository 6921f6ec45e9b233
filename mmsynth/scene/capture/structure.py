"""Structure from motion by COLMAP: poses and points from pictures that are matched (``matching``).

Poses come from grey pictures (``matching_picture``) by SIFT, pairwise matching, and incremental mapping. Seeds are fixed, mapping runs in
one thread, and what runs in two is done picture by picture: the same pictures give the same poses.
"""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.capture.matching import WELL_SEEN, Links, Picture, Shot, load_pycolmap, match_pictures
from mmsynth.sensors.camera import Camera, project

_WORTH = 0.95  # of the median error: a rig that was refined is taken below it
_FEW = 50  # points in a picture that shows no texture


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
    database, counts, links = match_pictures(folder, work, pictures, rig)
    if sum(count >= _FEW for count in counts.values()) < 2:
        raise InputError(f"{where}: no texture, {max(counts.values())} points at the most were found in a picture, expected some hundred.")
    if not links:
        raise InputError(f"{where}: no matches, no two of {len(pictures)} pictures show the same points, expected pictures that overlap.")
    models = _map(pycolmap, database, folder, work, pictures)
    if not models:
        raise InputError(f"{where}: {_why_no_start(pycolmap, database, links)}")
    best = models[0]
    _adjust(pycolmap, best, pictures)
    if rig is not None and len(rig) > 1:
        best = _with_rig_refined(pycolmap, best, pictures, rig)
    found = _structure(best, pictures, {} if rig is None else rig)
    lost, notes = _left_out(found.registered, pictures, models, counts, links, where)
    return replace(found, lost=lost, notes=(*notes, *_weak(pycolmap, database)))


def scaled(structure: Structure, scale: float) -> Structure:
    """The same in another unit, of which ``scale`` are one of the old."""
    structure.model.transform(load_pycolmap().Sim3d(scale=scale))

    def place(pose: np.ndarray) -> np.ndarray:
        out = pose.copy()
        out[:3, 3] *= scale
        return out

    registered = {shot: replace(r, camera_to_world=place(r.camera_to_world)) for shot, r in structure.registered.items()}
    return replace(structure, registered=registered, points=scale * structure.points)


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


def _with_rig_refined(pycolmap: Any, model: Any, pictures: Sequence[Picture], rig: Mapping[str, np.ndarray]) -> Any:
    """The model with the sensors' places on the rig adjusted, too, if that is worth it; lengths stay those of the rig's baselines."""
    refined = copy.deepcopy(model)
    _adjust(pycolmap, refined, pictures, rig=True)
    errors = [np.median([point.error for point in each.points3D.values()]) for each in (model, refined)]
    if errors[1] > _WORTH * errors[0]:
        return model
    places = _places(refined, pictures)
    stated = np.array([np.linalg.norm(rig[name][:3, 3]) for name in places])
    found = np.array([np.linalg.norm(place[:3, 3]) for place in places.values()])
    if stated @ found > 0:
        refined.transform(pycolmap.Sim3d(scale=float(stated @ stated / (stated @ found))))
    return refined


def _places(model: Any, pictures: Sequence[Picture]) -> dict[str, np.ndarray]:
    """(4, 4) camera to reference of every sensor that shares an instant with the reference."""
    shots = {picture.file: picture.shot for picture in pictures}
    seen = {shots[image.name]: image.cam_from_world().matrix() for image in model.images.values() if image.has_pose}
    to_camera = {shot: np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]]) for shot, matrix in seen.items()}
    reference = pictures[0].sensor
    return {s: to_camera[reference, v] @ np.linalg.inv(m) for (s, v), m in to_camera.items() if (reference, v) in to_camera}


def _adjust(pycolmap: Any, model: Any, pictures: Sequence[Picture], rig: bool = False) -> None:
    """One robust adjustment of everything, with the principal points of cameras that many pictures are of.

    Mapping takes every match within four pixels at its word. With Cauchy's loss, as wide as the median error, those that are off count
    little: poses of a rig of pictures of 160x120 came half as far from the truth.
    """
    known = all(picture.known for picture in pictures)
    of_camera: dict[int, int] = defaultdict(int)
    for image in model.images.values():
        of_camera[image.camera_id] += image.has_pose
    centred = not known and min(count for count in of_camera.values() if count) >= WELL_SEEN
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=not known, refine_extra_params=not known, refine_principal_point=centred, refine_sensor_from_rig=rig,
        print_summary=False,
    )  # fmt: skip
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = float(np.median([point.error for point in model.points3D.values()]))
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = 1e-6
    everything = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        everything.add_image(image)
    everything.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, everything, model).solve()  # pycolmap.bundle_adjustment, without its log
    model.update_point_3d_errors()


# --- what was found


def _camera_of(camera: Any) -> Camera:
    """COLMAP's camera in our conventions."""
    p = [float(value) for value in camera.params]
    if camera.model_name == "SIMPLE_RADIAL":
        p = [p[0], p[0], p[1], p[2], p[3], 0.0, 0.0, 0.0]
    lens = "kannala_brandt" if camera.model_name == "OPENCV_FISHEYE" else "brown_conrady"
    distortion = tuple(p[4:]) if any(p[4:]) or lens == "kannala_brandt" else ()
    return Camera(camera.width, camera.height, p[0], p[1], p[2] - 0.5, p[3] - 0.5, distortion, lens)  # type: ignore[arg-type]


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
    places = {**rig, **_places(model, pictures)} if rig else {}
    return Structure(registered, {}, positions, np.array([point.error for point in points]), places, (), model)


def _left_out(
    registered: Mapping[Shot, Registered],
    pictures: Sequence[Picture],
    models: Sequence[Any],
    counts: Mapping[Shot, int],
    links: Links,
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


def _why_no_start(pycolmap: Any, database: Path, links: Links) -> str:
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
