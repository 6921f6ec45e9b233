"""Arrays to image files, each written atomically. Every writer raises InputError where the disk refuses."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR

from mmsynth.errors import InputError
from mmsynth.files import write_atomic
from mmsynth.scene.images import first_line

_PARTS, _PART, _WORTH = 32, 32768, 0.8  # of an array that is tried: how many, bytes of each; what it must come to


def to_uint16(image: np.ndarray) -> np.ndarray:
    """Clip to [0, 1] and round to 0..65535. NaN (no value) becomes 0, because integers have none."""
    scaled = np.clip(np.nan_to_num(np.asarray(image), nan=0.0), 0.0, 1.0) * 65535.0
    return np.asarray(np.round(scaled), dtype=np.uint16)


def write_png16(path: Path, image: np.ndarray) -> None:
    """Write (H, W), (H, W, 1) or RGB (H, W, 3) values in [0, 1] as 16-bit PNG, see ``to_uint16`` and ``write_png``."""
    write_png(path, to_uint16(image))


def write_png(path: Path, numbers: np.ndarray) -> None:
    """Write uint8 or uint16 numbers (H, W), (H, W, 1) or RGB (H, W, 3) as they are; InputError for other channels."""
    if numbers.ndim == 3 and numbers.shape[2] == 3:
        numbers = cv2.cvtColor(numbers, cv2.COLOR_RGB2BGR)
    elif numbers.ndim != 2 and not (numbers.ndim == 3 and numbers.shape[2] == 1):
        raise InputError(f"{path}: an image of shape {numbers.shape} does not fit a PNG file, which holds one or three channels.")
    # encoded in memory: cv2.imwrite does not report a full disk
    data = cv2.imencode(".png", numbers)[1].tobytes()
    write_atomic(Path(path), lambda temporary: temporary.write_bytes(data))


def write_tiff(path: Path, numbers: np.ndarray) -> None:
    """Write numbers (H, W) or (H, W, C) as they are (zlib, any channel count)."""
    import tifffile  # a quarter of a second to import

    photometric = "rgb" if numbers.ndim == 3 and numbers.shape[2] == 3 else "minisblack"
    options: dict[str, Any] = {"planarconfig": "contig" if numbers.ndim == 3 else None, "compression": "zlib", "metadata": None}
    write_atomic(Path(path), lambda temporary: tifffile.imwrite(temporary, numbers, photometric=photometric, **options))


# XYZ to linear sRGB (IEC 61966-2-1), for a camera whose colours nobody measured
_XYZ_TO_RGB = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)


def write_dng(path: Path, numbers: np.ndarray, pattern: np.ndarray, black: int, white: int, model: str) -> None:
    """Write a Bayer frame as DNG 1.4, uncompressed.

    Args:
        numbers: (H, W) uint16. pattern: (2, 2), 0 red, 1 green, 2 blue. black, white: of ``numbers``. model: of the camera.
            Its colour matrix is that of sRGB: the file says what was measured, not which colours they are.
    """
    import tifffile

    rational = lambda values: tuple(x for v in values for x in (round(v * 10000), 10000))
    extra = [
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, bytes(int(c) for c in pattern.reshape(-1)), True),  # CFAPattern
        (50706, "B", 4, bytes((1, 4, 0, 0)), True),  # DNGVersion
        (50707, "B", 4, bytes((1, 1, 0, 0)), True),  # DNGBackwardVersion
        (50708, "s", 0, model, True),  # UniqueCameraModel
        (50714, "H", 1, black, True),  # BlackLevel
        (50717, "H", 1, white, True),  # WhiteLevel
        (50721, "2i", 9, rational(_XYZ_TO_RGB), True),  # ColorMatrix1
        (50728, "2I", 3, rational((1.0, 1.0, 1.0)), True),  # AsShotNeutral
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1: D65
    ]
    options: dict[str, Any] = {"compression": None, "metadata": None, "software": "mmsynth", "extratags": extra}
    write_atomic(Path(path), lambda temporary: tifffile.imwrite(temporary, numbers, photometric="cfa", **options))


def write_exr(path: Path, channels: Mapping[str, np.ndarray], attributes: Mapping[str, str] | None = None) -> None:
    """Write named (H, W) channels as OpenEXR (ZIP, lossless; NaN is kept): half floats as they are, all others as 32-bit floats."""
    arrays = {n: np.ascontiguousarray(c, None if c.dtype == np.float16 else np.float32) for n, c in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(attributes or {})}

    def write(temporary: Path) -> None:
        try:
            OpenEXR.File(header, arrays).write(str(temporary))
        except RuntimeError as error:
            raise OSError(first_line(error)) from error

    write_atomic(Path(path), write)


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write named arrays as npz, compressed where that saves enough (``_shrinks``); ``read_image`` reads the one called ``data``."""

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w") as archive:
            for name, array in arrays.items():
                entry = zipfile.ZipInfo(f"{name}.npy")
                entry.compress_type = zipfile.ZIP_DEFLATED if _shrinks(array) else zipfile.ZIP_STORED
                with archive.open(entry, "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)

    write_atomic(Path(path), write)


def _shrinks(array: np.ndarray) -> bool:
    """Whether a few parts of an array lose a fifth by compression: light and normals of full-size pictures lose a tenth, and take as long
    to compress as to render; masks, and pictures of an object before nothing, lose most."""
    parts = np.array_split(np.ravel(array), _PARTS)
    sample = b"".join(np.ascontiguousarray(part[: _PART // array.itemsize]).tobytes() for part in parts)
    return len(zlib.compress(sample)) < _WORTH * len(sample)


def write_tiff16(path: Path, image: np.ndarray) -> None:
    """Write (H, W) or (H, W, C) values in [0, 1] as 16-bit TIFF (zlib, any channel count); rounding as ``to_uint16``."""
    pixels = to_uint16(image)
    write_tiff(path, pixels[..., 0] if pixels.ndim == 3 and pixels.shape[2] == 1 else pixels)
