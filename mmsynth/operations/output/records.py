"""Named arrays of one picture as files, and back: npz, OpenEXR or TIFF.

A *record* is what belongs together: a modality (``data`` (H, W, C), for polarization also ``stokes`` (H, W, 3)), the geometry of a view.
Of a modality that a prior predicted and no sensor measured it also has ``deviation`` (H, W, C), and what is said of it has ``predicted``.

* npz: one file, every array as it is; channel names, wavelengths_nm (NaN = none) and polarizer_angles_deg beside the data.
* exr: one file of float channels. Data are named as in the spectral layout of Fichet, Pacanowski and Wilkie ("An OpenEXR Layout for
  Spectral Images", JCGT 2021): ``S0.692,000000nm`` where a channel has a wavelength, its own name elsewhere; a Stokes vector is ``S0``,
  ``S1``, ``S2``. Sensors that are neither RGB nor have one channel also get ``R``, ``G``, ``B`` in half precision, for viewers.
* tiff: one file an array; data 16-bit (clipped to [0, 1]) as STEM.tiff, all others float as STEM_KEY.tiff.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import sha256_of
from mmsynth.operations.output.previews import preview_linear
from mmsynth.scene.image_writers import write_exr, write_npz, write_tiff, write_tiff16
from mmsynth.scene.images import read_exr, read_native, read_npz
from mmsynth.scene.scene import Sensor
from mmsynth.scene.serialisation import channels_to_json

if TYPE_CHECKING:
    from mmsynth.field.field import Field

RecordFormat = Literal["npz", "exr", "tiff"]
RECORD_FORMATS: tuple[RecordFormat, ...] = get_args(RecordFormat)
UNITS = {"data": "full scale", "stokes": "full scale", "deviation": "full scale", "raw": "full scale", "flow": "px"}

_PARTS = {
    "stokes": ("S0", "S1", "S2"),
    "normal": ("N.X", "N.Y", "N.Z"),
    "normal_camera": ("NC.X", "NC.Y", "NC.Z"),
    "flow": ("flow.U", "flow.V"),
}


def field_hash(field: Field) -> str:
    """SHA-256 over the parameters and the rendering settings: two fields with one hash render the same."""
    digest = hashlib.sha256(repr(getattr(field, "sampling", None)).encode())
    digest.update(repr(field.manifest.get("prior")).encode() if field.predicted else b"")
    for name, tensor in sorted(field.state_dict().items()):
        value = tensor.detach().cpu().contiguous().numpy()
        digest.update(f"{name} {value.dtype} {value.shape}".encode())
        digest.update(value.tobytes())
    return digest.hexdigest()


def modality_arrays(values: np.ndarray, stokes: np.ndarray | None, deviation: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """The record of one modality: data (H, W, C) float32, for polarization stokes (H, W, 3), of a predicted one deviation (H, W, C)."""
    given = {"data": values, "stokes": stokes, "deviation": deviation}
    return {key: array.astype(np.float32) for key, array in given.items() if array is not None}


def write_record(
    folder: Path,
    stem: str,
    arrays: Mapping[str, np.ndarray],
    file_format: RecordFormat,
    *,
    units: Mapping[str, str],
    sensor: Sensor | None = None,
) -> dict[str, dict[str, Any]]:
    """Write a record.

    Args:
        arrays: (H, W) or (H, W, K) by name. units: of the arrays, by name; those not in it are pure numbers. sensor: of ``data``.
    Returns:
        per file name: record, sha256, bytes, and per array shape, dtype, unit and, in exr, the names of its channels; channel names,
        wavelengths and analyser angles of ``data``, and whether it was predicted.
    Raises:
        InputError: the disk refused.
    """
    predicted = "deviation" in arrays
    facts = {} if sensor is None else channels_to_json(sensor) | ({"predicted": True} if predicted else {})

    def entry(path: Path, keys: Mapping[str, str], channels: Mapping[str, list[str]] | None = None) -> dict[str, Any]:
        described = {
            key: {"shape": list(arrays[key].shape), "dtype": dtype, "unit": units.get(key, "1")}
            | ({} if channels is None else {"channels": channels[key]})
            for key, dtype in keys.items()
        }
        about = facts if "data" in keys else {}
        return {"record": stem, "sha256": sha256_of(path), "bytes": path.stat().st_size, "arrays": described, **about}

    own = {key: str(array.dtype) for key, array in arrays.items()}
    if file_format == "npz":
        path = folder / f"{stem}.npz"
        write_npz(path, {**arrays, **_labels_of(sensor), **({"predicted": np.array(True)} if predicted else {})})
        return {path.name: entry(path, own)}
    if file_format == "exr":
        path = folder / f"{stem}.exr"
        named = {key: _names(key, array, sensor) for key, array in arrays.items()}
        channels = {name: plane for key, array in arrays.items() for name, plane in zip(named[key], _planes(array), strict=True)}
        write_exr(path, {**channels, **_viewable(arrays, sensor)}, _LAYOUT if sensor is not None else {})
        return {path.name: entry(path, own, named)}
    out = {}
    for key, array in arrays.items():
        path = folder / (f"{stem}.tiff" if key == "data" else f"{stem}_{key}.tiff")
        if key == "data":
            write_tiff16(path, array)
        else:
            write_tiff(path, array.astype(np.float32))
        out[path.name] = entry(path, {key: "uint16" if key == "data" else own[key]})
    return out


def read_record(folder: Path, files: Mapping[str, Mapping[str, Any]], record: str) -> dict[str, np.ndarray]:
    """The arrays of a record as they were written; 16-bit data come back as float32 in [0, 1].

    Args:
        files: what ``write_record`` returned, of one or more records.
    Raises:
        InputError: a file or an array of it is missing or damaged, or there is no such record.
    """
    out: dict[str, np.ndarray] = {}
    for name, stated in files.items():
        if stated.get("record") != record:
            continue
        path = folder / name
        planes = read_npz(path) if path.suffix == ".npz" else read_exr(path) if path.suffix == ".exr" else {}
        for key, facts in stated["arrays"].items():
            names = facts.get("channels", [key])
            if planes and any(channel not in planes for channel in names):
                raise InputError(f"{path}: no '{key}' in it, expected {', '.join(names)}.")
            if not planes:
                array = read_native(path)
            else:
                array = planes[key] if "channels" not in facts else np.stack([planes[n] for n in names], -1)
            array = array.reshape(facts["shape"])
            # 16 bits are the share of full scale
            out[key] = array / np.float32(65535) if facts["dtype"] == "uint16" else array.astype(facts["dtype"])
    if not out:
        raise InputError(f"{folder}: no record '{record}', expected one of {', '.join(sorted({f['record'] for f in files.values()}))}.")
    return out


_LAYOUT = {"spectralLayoutVersion": "1.0", "emissiveUnits": "DN (1 = full scale)", "polarisationHandedness": "right"}


def _labels_of(sensor: Sensor | None) -> dict[str, np.ndarray]:
    """What an npz file says of its data."""
    if sensor is None:
        return {}
    waves = np.array([np.nan if w is None else w for w in sensor.wavelengths_nm], np.float32)
    out = {"channels": np.array(sensor.channels, dtype=np.str_), "wavelengths_nm": waves}
    if sensor.polarizer_angles_deg is not None:
        out["polarizer_angles_deg"] = np.array(sensor.polarizer_angles_deg, np.float32)
    return out


def _planes(array: np.ndarray) -> list[np.ndarray]:
    return [array] if array.ndim == 2 else [array[..., i] for i in range(array.shape[2])]


def _names(key: str, array: np.ndarray, sensor: Sensor | None) -> list[str]:
    """Names of an array's channels in an EXR file; a dot opens a layer."""
    if array.ndim == 2:
        return [{"depth_z": "Z"}.get(key, key)]
    if key != "data" or sensor is None:
        return [*_PARTS.get(key, [f"{key}.{i}" for i in range(array.shape[2])])]
    plain = [name.replace(".", "_") or f"channel{i}" for i, name in enumerate(sensor.channels)]
    plain = [f"I{name}" for name in plain] if sensor.is_polarization else plain
    waves = [None] * len(plain) if sensor.is_polarization else sensor.wavelengths_nm
    names = [label if w is None else f"S0.{f'{w:.6f}'.replace('.', ',')}nm" for label, w in zip(plain, waves, strict=True)]
    return names if len(set(names)) == len(names) else [f"{i}_{label}" for i, label in enumerate(plain)]


def _viewable(arrays: Mapping[str, np.ndarray], sensor: Sensor | None) -> dict[str, np.ndarray]:
    """R, G and B for a viewer that knows nothing else; where the data are not that already."""
    if sensor is None or sensor.channel_count == 1 or {"R", "G", "B"} & set(sensor.channels):
        return {}
    shown = preview_linear(sensor, arrays["data"]).astype(np.float16)
    return {label: shown[..., i] for i, label in enumerate("RGB")}
