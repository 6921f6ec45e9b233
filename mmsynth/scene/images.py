"""Image files to arrays: linear values, 1.0 = full scale, nothing converted in secret.

Values are taken as they are: a uint8 file is divided by 255 and a uint16 file by 65535 whatever the sensor's bit depth
(12-bit data must be stored left-aligned), a float file is not scaled at all and may exceed 1. No gamma is removed: an
8-bit sRGB photo stays gamma-encoded, and a field learned from it predicts gamma-encoded values.

``cv2`` silently returns the readable part of some damaged files, so PNG chunks (with CRC), JPEG markers and the lengths that WebP and BMP
files state are checked here.
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import cv2
import numpy as np
import OpenEXR

from mmsynth.errors import InputError, is_out_of_memory
from mmsynth.scene.scene import Frame, Sensor

_GREY = 12 / 255  # spread of the channels of a grey picture: lossy WebP leaves up to 9 codes
_CHECKED = (".png", ".jpg", ".jpeg", ".webp", ".bmp")
_BY_OPENCV = (
    ".jpe", ".apng", ".dib", ".jp2", ".avif", ".gif", ".pbm", ".pgm", ".ppm", ".pnm", ".pam", ".pfm", ".sr", ".ras", ".hdr", ".pic",
)  # fmt: skip
SUFFIXES = (*_CHECKED, ".tif", ".tiff", ".dng", ".npy", ".npz", ".exr", *_BY_OPENCV)
"""Of image files, in the order in which they are tried where a name has none."""


def read_image(path: Path) -> np.ndarray:
    """Read an image as linear float32, 1.0 = full scale.

    Colour files come in RGB or RGBA order; EXR channels that are not R, G, B, A in natural order of their names
    (2 before 10); an npz file holds the image under the key ``data``.

    Args:
        path: tif (uint8, uint16 or float), npy, npz (the same), exr, or what OpenCV reads: png, jpg, webp, bmp, ...
    Returns:
        (H, W) or (H, W, C) float32.
    Raises:
        InputError: missing, truncated or damaged file, unknown type, or NaN / infinity in a float file.
    """
    raw = read_native(path)
    return _finite(raw, path) if raw.dtype.kind == "f" else decode(raw)


def _finite(raw: np.ndarray, path: Path) -> np.ndarray:
    """As float32."""
    image = raw.astype(np.float32, copy=False)
    if not np.isfinite(image).all():
        row, column = np.argwhere(~np.isfinite(image))[0][:2]
        raise InputError(f"{path}: the pixel in row {row}, column {column} is not a finite number.")
    return image


def read_native(path: Path) -> np.ndarray:
    """The pixels as the file stores them: (H, W) or (H, W, C) uint8, uint16 or float; errors as ``read_image``."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: unknown image type '{path.suffix}', expected one of {' '.join(SUFFIXES)}.")
    if not path.is_file():
        raise InputError(f"{path}: no such image file.")
    readers = {".tif": _read_tiff, ".tiff": _read_tiff, ".dng": _read_dng, ".exr": _read_exr, ".npy": _read_numpy, ".npz": _read_numpy}
    try:
        image = readers.get(suffix, _read_photo)(path)
    except InputError:
        raise
    except Exception as error:  # each library has its own zoo of exceptions for a damaged file
        if is_out_of_memory(error):
            raise
        raise InputError(f"{path}: damaged or truncated image, could not be read ({first_line(error)}).") from error
    if image.dtype not in (np.uint8, np.uint16) and image.dtype.kind != "f":
        raise InputError(f"{path}: pixels of type {image.dtype}, expected uint8, uint16 or float.")
    if image.ndim not in (2, 3) or image.size == 0:
        raise InputError(f"{path}: array of shape {image.shape}, expected (height, width) or (height, width, channels).")
    return image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image


def read_npz(file: Path | IO[bytes], name: Path | str = "") -> dict[str, np.ndarray]:
    """All arrays of an npz file; ``name``: for errors. Raises InputError: missing or damaged."""
    try:
        with np.load(file) as arrays:
            return {key: arrays[key] for key in arrays.files}
    except Exception as error:  # zipfile, zlib and numpy each have their own
        if is_out_of_memory(error):
            raise
        raise InputError(f"{name or file}: damaged or missing, could not be read ({first_line(error)}).") from error


def check_file(path: Path) -> None:
    """Check that a picture is complete: PNG, JPEG, WebP and BMP without decoding it; arrays, TIFF and EXR are only checked to exist.

    Raises:
        InputError: missing, truncated or damaged.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such image file.")
    if path.suffix.lower() in _CHECKED:
        _check_photo(path.read_bytes(), path)
    elif path.suffix.lower() in _BY_OPENCV:
        read_native(path)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, of most types without decoding the pixels; errors as ``read_image``."""
    from PIL import Image, UnidentifiedImageError

    if path.suffix.lower() in (*_CHECKED, *_BY_OPENCV):
        try:
            with Image.open(path) as image:
                return image.size
        except (OSError, ValueError, SyntaxError, UnidentifiedImageError, Image.DecompressionBombError):
            pass  # what Pillow does not know, or damage, which the reader names
    height, width = read_native(path).shape[:2]
    return width, height


def load_frame(sensor: Sensor, frame: Frame) -> tuple[np.ndarray, np.ndarray | None]:
    """Read a frame and check it against its camera and sensor.

    Returns:
        pixels: (H, W) float32 for a mosaicked sensor (raw, never demosaicked), else (H, W, C), C = 1 for mono. A grey picture that is
            stored as colour, for a sensor of one channel, is the mean of its channels.
        alpha: (H, W) float32 where the file has one channel more than a 1- or 3-channel sensor, else None. Colours are not
            multiplied by it.
    Raises:
        InputError: unreadable file, or size or channel count other than expected.
    """
    image = decode(stored_frame(sensor, frame))
    if sensor.mosaic is not None:
        return image[..., 0], None
    count = sensor.channel_count
    if image.shape[2] == count:
        return image, None
    return np.ascontiguousarray(image[..., :count]), np.ascontiguousarray(image[..., count])


def stored_frame(sensor: Sensor, frame: Frame) -> np.ndarray:
    """``load_frame`` as the file stores it: (H, W, C) uint8, uint16 or float32, C = 1 for a mosaicked sensor; alpha, if any, comes last.

    Raises:
        InputError: as ``load_frame``.
    """
    image = read_native(frame.path)
    if image.dtype.kind == "f":
        image = _finite(image, frame.path)
    expected = (frame.camera.height, frame.camera.width)
    if image.shape[:2] != expected:
        raise InputError(
            f"{frame.path}: the image is {image.shape[1]}x{image.shape[0]} pixels, "
            f"expected {expected[1]}x{expected[0]} as the camera of '{sensor.name}' says."
        )
    if sensor.mosaic is not None and image.ndim != 2:
        raise InputError(f"{frame.path}: {image.shape[2]} channels, expected one: the frames of '{sensor.name}' are mosaicked.")
    image = image[..., None] if image.ndim == 2 else image
    count = sensor.values_per_pixel
    if image.shape[2] == count or (count in (1, 3) and image.shape[2] == count + 1):
        return image
    if count == 1 and image.shape[2] in (3, 4) and is_grey(image):
        if np.ptp(image[..., :3], axis=2).max() == 0:
            return image[..., [0] if image.shape[2] == 3 else [0, 3]]
        values = decode(image)
        return np.concatenate([values[..., :3].mean(2, keepdims=True), values[..., 3:]], 2)
    raise InputError(f"{frame.path}: {image.shape[2]} channels, expected {count} for '{sensor.name}'.")


def decode(stored: np.ndarray) -> np.ndarray:
    """Codes of an unsigned integer image, or float32, → float32, 1.0 = full scale."""
    return stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max) if stored.dtype.kind == "u" else stored


def is_grey(image: np.ndarray) -> bool:
    """Whether the first three channels (H, W, C) are one, but for what lossy compression of a grey picture makes of them."""
    scale = np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1.0
    return bool(np.ptp(image[..., :3].astype(np.float32), axis=2).max() <= _GREY * scale)


def used_bits(raw: np.ndarray) -> int:
    """How many high bits of an unsigned integer image are in use: 12 for 12-bit data stored left-aligned in uint16.

    Counted from the low bits that are zero in every pixel. An image too plain to tell (fewer than 8 bits in use) counts as full.
    """
    bits = raw.dtype.itemsize * 8
    seen = int(np.bitwise_or.reduce(raw, axis=None))
    empty = (seen & -seen).bit_length() - 1 if seen else 0
    return bits - empty if bits - empty >= 8 else bits


def saturation_level(raw: np.ndarray) -> float:
    """From which value (1.0 = full scale) pixels of files like this one count as clipped.

    0.998 of the highest code that its bits can hold: 65520/65535 for left-aligned 12-bit data, where the margin covers
    the upper 9 of 4096 codes; in 8-bit files it is the code 255 alone. A float file has no full scale at which it clips: infinity.
    """
    if raw.dtype.kind == "f":
        return float("inf")
    bits = raw.dtype.itemsize * 8
    top = 2**bits - 2 ** (bits - used_bits(raw))
    return 0.998 * top / (2**bits - 1)


class _Silence:
    """How many threads have OpenCV be silent, and its level before."""

    lock, threads, level = threading.Lock(), 0, 0


@contextlib.contextmanager
def _silent_opencv() -> Iterator[None]:
    with _Silence.lock:
        if _Silence.threads == 0:
            _Silence.level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        _Silence.threads += 1
    try:
        yield
    finally:
        with _Silence.lock:
            _Silence.threads -= 1
            if _Silence.threads == 0:
                cv2.utils.logging.setLogLevel(_Silence.level)


def _read_photo(path: Path) -> np.ndarray:
    data = path.read_bytes()
    _check_photo(data, path)
    with _silent_opencv():  # what is wrong is said below, in one sentence
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{path}: damaged image, could not be decoded.")
    if image.ndim == 2 or image.shape[2] not in (3, 4):
        return np.asarray(image)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))


def _read_tiff(path: Path) -> np.ndarray:
    """Samples stored in planes, and pages of one size, become channels: always (H, W) or (H, W, C)."""
    import tifffile  # a quarter of a second to import

    with tifffile.TiffFile(path) as file:
        size = path.stat().st_size
        for page in file.pages:
            if not isinstance(page, tifffile.TiffPage):
                continue
            if any(offset + count > size for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True)):
                raise InputError(f"{path}: truncated image, the file ends at byte {size} inside the pixels.")
        series = file.series[0]
        image = np.asarray(series.asarray())
        return np.moveaxis(image, 0, -1) if image.ndim == 3 and series.axes[-1] == "X" else image


def _read_dng(path: Path) -> np.ndarray:
    """The mosaic as stored, (H, W); previews beside it are passed over."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        pages = [page for top in file.pages if isinstance(top, tifffile.TiffPage) for page in (top, *(top.pages or ()))]
        for page in pages:
            if isinstance(page, tifffile.TiffPage) and page.photometric == tifffile.PHOTOMETRIC.CFA:
                return np.asarray(page.asarray())
    raise InputError(f"{path}: no mosaic in this DNG file, expected a colour filter array.")


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """The channels (H, W) of an EXR file, by name. Raises InputError: missing or damaged."""
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its warnings there, and --json promises nothing else
            file = OpenEXR.File(str(path), separate_channels=True)
        return {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise InputError(f"{path}: damaged or truncated image, could not be read ({first_line(error)}).") from error


def _read_exr(path: Path) -> np.ndarray:
    channels = read_exr(path)
    if any(name.startswith("S0.") and name.endswith("nm") for name in channels):
        channels = {name: pixels for name, pixels in channels.items() if name not in ("R", "G", "B", "A")}  # a preview of the spectrum
    colour = [name for name in ("R", "G", "B", "A") if name in channels]
    names = colour if set(colour) == set(channels) else sorted(channels, key=_natural)
    return np.stack([channels[name] for name in names], -1)


def _read_numpy(path: Path) -> np.ndarray:
    loaded = np.load(path, allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return loaded
    with loaded:
        if "data" not in loaded:
            raise InputError(f"{path}: no array 'data', expected one of shape (height, width, channels).")
        return np.asarray(loaded["data"])


def _check_photo(data: bytes, path: Path) -> None:
    """Dispatch by content: a JPEG named .png is still a JPEG."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        _check_png(data, path)
    elif data[:2] == b"\xff\xd8":
        _check_jpeg(data, path)
    elif data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        _check_length(data, 8 + int.from_bytes(data[4:8], "little"), path)
    elif data[:2] == b"BM" and len(data) >= 14:
        _check_length(data, int.from_bytes(data[2:6], "little"), path)
    elif path.suffix.lower() in _CHECKED:
        raise InputError(f"{path}: damaged image, neither PNG, JPEG, WebP nor BMP data.")


def _check_length(data: bytes, stated: int, path: Path) -> None:
    if len(data) < stated:
        raise InputError(f"{path}: truncated image, the file has {len(data)} of the {stated} bytes that it states.")


def _check_png(data: bytes, path: Path) -> None:
    """Walk the chunks down to IEND and check each CRC."""
    view = memoryview(data)
    position = 8
    while position + 12 <= len(view):
        length, kind = struct.unpack_from(">I4s", view, position)
        end = position + 12 + length
        if end > len(view):
            break
        (crc,) = struct.unpack_from(">I", view, end - 4)
        if zlib.crc32(view[position + 4 : end - 4]) != crc:
            raise InputError(f"{path}: damaged PNG, the checksum of the chunk at byte {position} is wrong.")
        if kind == b"IEND":
            return
        position = end
    raise InputError(f"{path}: truncated PNG, the file ends at byte {len(view)} before its end marker (IEND).")


# in entropy-coded data every 0xFF is followed by 0x00 (stuffing), a restart marker or another 0xFF (fill)
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")


def _check_jpeg(data: bytes, path: Path) -> None:
    """Walk the segments down to EOI: searching for EOI alone would find the one of an embedded thumbnail."""
    position = 2
    while position + 2 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xD9:
            return
        if marker == 0xFF:
            position += 1
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:
            position += 2
        else:
            position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
            if marker == 0xDA:
                found = _JPEG_MARKER.search(data, position)
                position = found.start() if found else len(data)
    raise InputError(f"{path}: truncated JPEG, the file of {len(data)} bytes has no end marker (EOI).")


def _natural(name: str) -> list[tuple[bool, int | str]]:
    return [(True, int(part)) if part.isdigit() else (False, part) for part in re.split(r"(\d+)", name) if part]


def first_line(error: BaseException) -> str:
    """What another library says, without its full stop."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
