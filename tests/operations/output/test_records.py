"""Named arrays as files and back, in every format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from analytic import MONO, MS, POL, RGB

from mmsynth.errors import InputError
from mmsynth.operations.output.records import UNITS, modality_arrays, read_record, write_record
from mmsynth.scene.images import read_image
from mmsynth.scene.scene import PosedCamera, Sensor
from mmsynth.scene.serialisation import posed_from_json, posed_to_json
from mmsynth.sensors.camera import Camera


def arrays_of(sensor: Sensor) -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    values = random.random((7, 5, sensor.channel_count)).astype(np.float32)
    values[0, 0] = np.nan
    out = modality_arrays(values, random.random((7, 5, 3)) if sensor.is_polarization else None)
    return out | {
        "valid": values[..., 0] > 0.3,
        "flow": random.normal(size=(7, 5, 2)).astype(np.float32),
        "confidence": random.random((7, 5)),
    }


@pytest.mark.parametrize("sensor", [RGB, MONO, MS, POL], ids=lambda s: s.name)
@pytest.mark.parametrize("file_format", ["npz", "exr", "tiff"])
def test_what_is_written_comes_back(tmp_path: Path, sensor: Sensor, file_format: Any) -> None:
    arrays = arrays_of(sensor)
    files = write_record(tmp_path, sensor.name, arrays, file_format, units=UNITS, sensor=sensor)
    files |= write_record(tmp_path, "other", {"depth_z": arrays["confidence"]}, file_format, units={"depth_z": "m"})
    back = read_record(tmp_path, files, sensor.name)
    assert back.keys() == arrays.keys()
    for key, array in arrays.items():
        assert back[key].dtype == array.dtype, key
        if key == "data" and file_format == "tiff":
            np.testing.assert_allclose(back[key][1:], array[1:], atol=0.51 / 65535)
        elif array.dtype == np.float64 and file_format != "npz":
            np.testing.assert_allclose(back[key], array, rtol=1e-7)
        else:
            np.testing.assert_array_equal(back[key], array, key)
    of_data = next(f for f in files.values() if "data" in f["arrays"])
    assert of_data["channels"] == list(sensor.channels) and of_data["wavelengths_nm"] == list(sensor.wavelengths_nm)
    assert of_data["arrays"]["data"]["unit"] == "full scale" and sorted(files) == sorted(p.name for p in tmp_path.iterdir())
    with pytest.raises(InputError, match=f"no record 'thermal', expected one of {', '.join(sorted((sensor.name, 'other')))}"):
        read_record(tmp_path, files, "thermal")
    path = tmp_path / next(name for name in files if name.startswith(sensor.name))
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InputError, match=path.name):
        read_record(tmp_path, files, sensor.name)


def test_spectra_and_stokes_vectors_have_the_names_of_the_spectral_layout(tmp_path: Path) -> None:
    for sensor in (MS, POL, RGB):
        write_record(tmp_path, sensor.name, modality_arrays(**_of(sensor)), "exr", units=UNITS, sensor=sensor)
    ms, pol, rgb = (OpenEXR.File(str(tmp_path / f"{n}.exr"), separate_channels=True) for n in ("ms", "pol", "rgb"))
    assert {"S0.692,000000nm", "S0.431,000000nm", "pan", "R", "G", "B"} < set(ms.channels()) and len(ms.channels()) == 12
    assert ms.channels()["R"].pixels.dtype == np.float16 and ms.header()["spectralLayoutVersion"] == "1.0"
    assert {"S0", "S1", "S2", "I0", "I45", "I90", "I135"} < set(pol.channels())
    assert set(rgb.channels()) == {"R", "G", "B"}
    np.testing.assert_array_equal(pol.channels()["S1"].pixels, _of(POL)["stokes"][..., 1])
    assert read_image(tmp_path / "ms.exr").shape == (4, 3, 9)  # a preview is not a band


def _of(sensor: Sensor) -> dict[str, np.ndarray]:
    values = np.arange(12.0 * sensor.channel_count, dtype=np.float32).reshape(4, 3, -1)
    return {"values": values, "stokes": values[..., :3] if sensor.is_polarization else None}  # type: ignore[dict-item]


def test_cameras_come_back() -> None:
    for camera in (
        Camera(4, 3, 5.0, 6.0, 1.5, 1.0, (0.1, 0.2, 0.0, 0.01)),
        Camera(4, 3, 5.0, 6.0, 1.5, 1.0, (0.1, 0.0, 0.0, 0.0), "kannala_brandt"),
    ):
        again = posed_from_json(posed_to_json(PosedCamera(camera, np.diag([1.0, -1.0, -1.0, 1.0]))))
        assert again.camera == camera and np.array_equal(again.camera_to_world, np.diag([1.0, -1.0, -1.0, 1.0]))
