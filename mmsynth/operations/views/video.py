"""A path through a field as a video."""

from __future__ import annotations

import functools
import os
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from mmsynth.errors import InputError
from mmsynth.operations.output import previews
from mmsynth.operations.output.progress import Progress
from mmsynth.operations.views.coverage import TrainingRays, coverage, training_rays
from mmsynth.operations.views.displays import Display, exposure_key, exposures_of, find_display, label_of, look, picture
from mmsynth.operations.views.load import load_views
from mmsynth.scene.preview_colours import PreviewColours, preview_colours
from mmsynth.scene.scene import PosedCamera, Scene
from mmsynth.sensors.camera import resized

if TYPE_CHECKING:
    from mmsynth.field.field import Field

_EXPOSED_BY = 5  # pictures of the path
_EXPOSED_WIDTH = 96
_STRIP = 18  # pixels, of names above pictures that stand beside each other
_BRIGHTEST = 0.9  # of the pictures' exposures, the one that this quantile of them stays below


def write_video(
    field: Field,
    poses: Sequence[PosedCamera] | Path | str,
    path: Path,
    show: Sequence[str] = ("rgb",),
    rate: float = 24.0,
    *,
    width: int | None = None,
    scene: Scene | None = None,
    progress: Progress | None = None,
) -> int:
    """Film a path; see ``video_steps``.

    Args:
        poses: cameras, or a file as ``load_views`` reads it. show: names of displays. width: pixels of a row; None: as cameras have them.
        scene: for trajectories, coverage and the colours of previews. progress: called with (pictures done, pictures in all).
    Returns:
        the number of pictures.
    Raises:
        InputError: as ``find_display``, ``load_views`` and ``video_steps``.
    """
    displays = [find_display(field, name) for name in show]
    views = list(load_views(poses, field, scene))
    if width is not None:
        views = [PosedCamera(resized(v.camera, width), v.camera_to_world, v.name) for v in views]
    training = functools.cache(lambda: None if scene is None else training_rays(field, scene))
    colours = None if scene is None else preview_colours(scene)
    for done, total in video_steps(field, views, displays, path, rate, colours=colours, training=training):
        if progress is not None:
            progress(done, total)
    return len(views)


def video_steps(
    field: Field,
    views: Sequence[PosedCamera],
    displays: Sequence[Display],
    path: Path,
    rate: float = 24.0,
    *,
    colours: Mapping[str, PreviewColours] | None = None,
    training: Callable[[], TrainingRays | None] = lambda: None,
) -> Iterator[tuple[int, int]]:
    """Write a video (mp4, MPEG-4 part 2, as OpenCV's wheels have it) of a path, the displays beside each other, under one exposure.

    Args:
        views: of the same size. rate: pictures a second. colours: of previews, by modality. training: the training frames' depth maps,
            asked for where coverage is shown.
    Returns:
        an iterator that makes one picture at a time and gives (pictures done, pictures in all); the file is there when it ends, and no part
        of it where it is given up before.
    Raises:
        InputError: no views or displays, views whose sizes differ, or a file that cannot be written.
    """
    if not views or not displays:
        raise InputError("video: no poses, or nothing to show.")
    if len({(v.camera.width, v.camera.height) for v in views}) > 1:
        raise InputError("video: the cameras of the poses have pictures of several sizes, expected one.")
    if path.suffix.lower() != ".mp4":
        raise InputError(f"{path}: expected a file that ends in .mp4.")
    exposures, depths = _of_the_path(field, views, displays, colours)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    writer = None
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # it warns of each picture that did not reach the disk
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for index, view in enumerate(views):
            frame = _frame(field, view, displays, exposures, depths, colours, training)
            if writer is None:
                writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), rate, (frame.shape[1], frame.shape[0]))
                if not writer.isOpened():
                    raise InputError(
                        f"{path}: could not be written (OpenCV opened no mp4 writer for {frame.shape[1]}x{frame.shape[0]} pixels)."
                    )
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
            yield index + 1, len(views)
        if writer is not None:
            writer.release()
        if not _is_whole(temporary):  # OpenCV reports no failure
            raise InputError(f"{path}: could not be written (it is cut off: the disk may be full).")
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: could not be written ({error.strerror or error}).") from error
    finally:
        if writer is not None:
            writer.release()
        temporary.unlink(missing_ok=True)
        cv2.utils.logging.setLogLevel(level)


def _is_whole(path: Path) -> bool:
    """Whether an mp4 file has all of its boxes, each of which begins with its size (ISO 14496-12); its index is written last."""
    end, at, names = path.stat().st_size, 0, set()
    with open(path, "rb") as stream:
        while at + 16 <= end:
            stream.seek(at)
            size, name, long_size = struct.unpack(">I4sQ", stream.read(16))
            names.add(name)
            at += long_size if size == 1 else max(size, 8)
    return at == end and b"moov" in names


def _of_the_path(
    field: Field, views: Sequence[PosedCamera], displays: Sequence[Display], colours: Mapping[str, PreviewColours] | None
) -> tuple[dict[str, float], tuple[float, float] | None]:
    """Exposures by display, and the range of depths, that suit a few pictures of the path."""
    found: dict[str, list[float]] = {}
    depths = []
    for index in np.unique(np.linspace(0, len(views) - 1, _EXPOSED_BY).astype(int)):
        view = views[index]
        small = PosedCamera(resized(view.camera, min(_EXPOSED_WIDTH, view.camera.width)), view.camera_to_world)
        seen = look(field, small, displays)
        assert seen is not None
        for key, value in exposures_of(field, displays, seen, colours).items():
            found.setdefault(key, []).append(value)
        hit = seen["depth"][np.isfinite(seen["depth"])]
        depths += [*np.percentile(hit, (2.0, 98.0))] if hit.size else []
    exposures = {key: float(np.quantile(values, 1.0 - _BRIGHTEST)) for key, values in found.items()}
    return exposures, (float(min(depths)), float(max(depths))) if depths else None


def _frame(
    field: Field,
    view: PosedCamera,
    displays: Sequence[Display],
    exposures: Mapping[str, float],
    depths: tuple[float, float] | None,
    colours: Mapping[str, PreviewColours] | None,
    training: Callable[[], TrainingRays | None],
) -> np.ndarray:
    """(H, W, 3) uint8, of even height and width, as the codec wants them."""
    seen = look(field, view, displays)
    assert seen is not None
    if any(display.kind == "coverage" for display in displays) and (rays := training()) is not None:
        seen = {**seen, "coverage": coverage(rays, view, seen["depth"] * np.float32(field.region.radius), seen["normal"])}
    pictures = [picture(field, d, seen, exposures.get(exposure_key(d), 1.0), 1.0, colours, depths) for d in displays]
    if len(pictures) > 1:
        pictures = [_named(image, label_of(field, display)) for image, display in zip(pictures, displays, strict=True)]
    joined = np.concatenate([previews.as_rgb(image) for image in pictures], 1)
    height, width = joined.shape[:2]
    return np.pad(joined, ((0, height % 2), (0, width % 2), (0, 0)))


def _named(image: np.ndarray, name: str) -> np.ndarray:
    out = np.pad(image, ((_STRIP, 0), (0, 0), (0, 0)))
    cv2.putText(out, name, (4, _STRIP - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (230, 230, 230), 1, cv2.LINE_AA)
    return out
