"""Points of pictures and their matches, in COLMAP's database: SIFT, pairs that are likely to match, nearest descriptors, and verification
by epipolar geometry.

Needs pycolmap (``pip install 'mmsynth[capture]'``), which ``load_pycolmap`` alone imports.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap: loaded after it, its PNG writer finds pycolmap's zlib and crashes
import numpy as np

from mmsynth.errors import InputError
from mmsynth.scene.capture.likely_pairs import likely_pairs
from mmsynth.scene.capture.nearest import mutual_matches
from mmsynth.sensors.camera import Camera

_THREADS = 2
_FEATURES = 4096  # in a picture at the most
_LARGE = 1000  # pixels a side above which the finest octave of SIFT, of a picture made twice as large, is left out
_LARGEST = 2000  # pixels a side at which pictures are searched at the most
_LINKS = 8  # views with the most matches in the reference sensor: there other sensors are matched
WELL_SEEN = 10
"""Pictures of a camera from which all of its intrinsics are found."""

Shot = tuple[str, int]
"""Sensor and view."""
Links = dict[tuple[Shot, Shot], int]
"""Pairs of pictures that match, and how many points agree on where they were taken from."""


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
class _Features:
    """Of a picture: descriptors (N, 128) uint8, scales (N,) px."""

    descriptors: np.ndarray
    scales: np.ndarray


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


def match_pictures(
    folder: Path, work: Path, pictures: Sequence[Picture], rig: Mapping[str, np.ndarray] | None
) -> tuple[Path, dict[Shot, int], Links]:
    """Fill a database with cameras, points and matches; arguments as ``reconstruct``.

    Returns:
        its file, how many points each picture has, and which pictures match.
    """
    pycolmap = load_pycolmap()
    database = work / "database.db"
    ids = _import(pycolmap, database, folder, pictures)
    _extract(pycolmap, database, folder, pictures)
    if rig is not None:
        _apply_rig(pycolmap, database, rig)
    features = _features(pycolmap, database, ids)
    counts = {shot: len(found.scales) for shot, found in features.items()}
    return database, counts, _match(pycolmap, database, pictures, ids, features)


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
    elif picture.known or count >= WELL_SEEN:
        model, parameters = "OPENCV", values + coefficients[:4]
    else:
        model, parameters = "SIMPLE_RADIAL", [camera.fx, *values[2:], 0.0]
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=parameters)


def _extract(pycolmap: Any, database: Path, folder: Path, pictures: Sequence[Picture]) -> None:
    large = max(max(p.camera.width, p.camera.height) for p in pictures) > _LARGE
    options = pycolmap.FeatureExtractionOptions(num_threads=_THREADS, use_gpu=False, max_image_size=_LARGEST)
    options.sift.max_num_features = _FEATURES
    options.sift.first_octave = 0 if large else -1
    pycolmap.extract_features(database, folder, [p.file for p in pictures], extraction_options=options, device=pycolmap.Device.cpu)


def _features(pycolmap: Any, database: Path, ids: Mapping[Shot, int]) -> dict[Shot, _Features]:
    opened = pycolmap.Database.open(database)
    out = {}
    for shot, number in ids.items():
        points = np.asarray(opened.read_keypoints(number)).reshape(-1, 6)  # x, y and the four numbers of an affine shape
        scales = np.sqrt(np.abs(points[:, 2] * points[:, 5] - points[:, 3] * points[:, 4]))
        out[shot] = _Features(np.asarray(opened.read_descriptors(number).data, dtype=np.uint8), scales)
    opened.close()
    return out


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


def _match(
    pycolmap: Any, database: Path, pictures: Sequence[Picture], ids: Mapping[Shot, int], features: Mapping[Shot, _Features]
) -> Links:
    """Match the reference sensor's pictures, then those of others where the reference's show the same; gives inliers of pairs."""
    shots = [picture.shot for picture in pictures]
    reference = shots[0][0]
    of_reference = [shot for shot in shots if shot[0] == reference]
    likely = likely_pairs([features[shot].descriptors for shot in of_reference], [features[shot].scales for shot in of_reference])
    _match_pairs(pycolmap, database, [(of_reference[i], of_reference[j]) for i, j in likely], ids, features)
    links = _inliers(pycolmap, database, ids)
    if len(of_reference) < len(shots) and links:
        near: dict[int, set[int]] = defaultdict(set)
        for view in {view for _, view in shots}:
            of_view = sorted(
                ((count, b[1] if a[1] == view else a[1]) for (a, b), count in links.items() if view in (a[1], b[1])), reverse=True
            )
            near[view] = {view} | {other for _, other in of_view[:_LINKS]}
        _match_pairs(pycolmap, database, list(_across(shots, near)), ids, features)
        links = _inliers(pycolmap, database, ids)
    return links


def _across(shots: Sequence[Shot], near: Mapping[int, set[int]]) -> Iterable[tuple[Shot, Shot]]:
    """Pairs of pictures of views that see the same, but for the reference's own: the first one's sensor."""
    reference = shots[0][0]
    for i, a in enumerate(shots):
        for b in shots[i + 1 :]:
            if (a[0] != reference or b[0] != reference) and (b[1] in near[a[1]] or a[1] in near[b[1]]):
                yield a, b


def _match_pairs(
    pycolmap: Any, database: Path, pairs: Iterable[tuple[Shot, Shot]], ids: Mapping[Shot, int], features: Mapping[Shot, _Features]
) -> None:
    """Write matches of pairs, and which of them agree on where the pictures were taken from."""
    opened = pycolmap.Database.open(database)
    for a, b in pairs:
        opened.write_matches(ids[a], ids[b], mutual_matches(features[a].descriptors, features[b].descriptors))
    opened.close()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.geometric_verification(
        database, pycolmap.GeometricVerifierOptions(num_threads=_THREADS), two_view_geometry_options=verification
    )


def _inliers(pycolmap: Any, database: Path, ids: Mapping[Shot, int]) -> Links:
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
