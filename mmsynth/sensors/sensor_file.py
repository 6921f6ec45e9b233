"""The file that describes a sensor: TOML, read into one pydantic model. Packaged ones are in ``recipes/sensors``.

A sensor is one of two things. An *instance* of a captured sensor (``instance_of = "rgb"``) records what the field learned from that
sensor: its response, analysers, blur and vignetting are in the field already, and the file's ``channels`` are facts about them. A
*virtual* sensor has channels of its own: each a trained channel (``of = "rgb.R"``), or a response over wavelength that is put together
from the responses of captured sensors (``measured``), either of them behind a polarizer or not.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomli_w
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from mmsynth.errors import InputError
from mmsynth.packaged import data_folder
from mmsynth.sensors.camera import Camera
from mmsynth.sensors.mosaic import pattern_of
from mmsynth.sensors.noise import NoiseModel
from mmsynth.sensors.polarization import OffAxis
from mmsynth.toml import read_toml

_Positive = Annotated[float, Field(gt=0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Response(_Strict):
    """Sensitivity over wavelength: a table, or a Gaussian peak. All sensors of a scene in the same unit, whatever it is.

    Attributes:
        nm, value: the table, linear between its entries and 0 beyond them. centre_nm, fwhm_nm, peak: the Gaussian.
    """

    nm: tuple[_Positive, ...] = ()
    value: tuple[Annotated[float, Field(ge=0)], ...] = ()
    centre_nm: float | None = Field(None, gt=0)
    fwhm_nm: float | None = Field(None, gt=0)
    peak: float | None = Field(None, gt=0, description="of the Gaussian; none: 1")

    @model_validator(mode="after")
    def _one_of_two(self) -> Response:
        table, peak = bool(self.nm or self.value), not self.centre_nm == self.fwhm_nm == self.peak is None
        if table == peak:
            raise ValueError("expected either 'nm' and 'value', or 'centre_nm' and 'fwhm_nm'")
        if table and (len(self.nm) != len(self.value) or len(self.nm) < 2 or np.any(np.diff(self.nm) <= 0)):
            raise ValueError("'nm' and 'value' must be lists of one length, of at least 2 wavelengths that increase")
        if table and not any(self.value):
            raise ValueError("'value' is 0 everywhere, expected a response")
        if peak and (self.centre_nm is None or self.fwhm_nm is None):
            raise ValueError("expected both 'centre_nm' and 'fwhm_nm'")
        return self

    def at(self, nm: np.ndarray) -> np.ndarray:
        """Sensitivity at wavelengths (N,) nm → (N,)."""
        if self.centre_nm is None or self.fwhm_nm is None:
            return np.interp(nm, self.nm, self.value, left=0.0, right=0.0)
        return np.asarray((self.peak or 1.0) * np.exp(-4.0 * math.log(2.0) * ((nm - self.centre_nm) / self.fwhm_nm) ** 2))

    def detail_nm(self) -> float:
        """Width of its narrowest detail: FWHM, or the least distance in the table."""
        return float(np.diff(self.nm).min()) if self.fwhm_nm is None else self.fwhm_nm

    def range_nm(self) -> tuple[float, float]:
        """Where it is not negligible."""
        if self.centre_nm is None or self.fwhm_nm is None:
            return self.nm[0], self.nm[-1]
        return self.centre_nm - 2.0 * self.fwhm_nm, self.centre_nm + 2.0 * self.fwhm_nm


class Polarizer(_Strict):
    """The analyser over a channel's photosites, see ``polarization.analyser_matrix``."""

    angle_deg: float = Field(description="of its transmission axis, from image right towards image up")
    extinction_ratio: float = Field(math.inf, gt=1, allow_inf_nan=True)
    throughput: float = Field(1.0, gt=0, le=1, description="share of unpolarized light that it passes, times two")


class Channel(_Strict):
    """What the photosites of one index of the mosaic measure."""

    label: str = Field(min_length=1)
    of: str | None = Field(None, description="a trained channel, MODALITY.LABEL")
    response: Response | None = None
    polarizer: Polarizer | None = None


class SensorFile(_Strict):
    """A sensor: how light becomes its raw frames. Units and names of EMVA 1288.

    Attributes:
        camera: size, intrinsics and lens; none: those of the captured sensor, or of the poses.
        camera_to_reference: (4, 4) rigid, its place on the rig, OpenCV axes, scene unit; none: that of the captured sensor, or the
            reference's own.
        mosaic: channel of each photosite of a tile, whose corner is at ``mosaic_offset`` before pixel (0, 0); none: every pixel has all
            channels.
        alignment: of the numbers in 16-bit files: "msb" shifts them up (what MMS-DATA has), "lsb" does not.
        exposure: gain on light before anything else. psf_sigma_px: of a Gaussian blur before the pixels.
        vignetting: k1 k2 k3 of 1 + k1 r² + k2 r⁴ + k3 r⁶, r = 1 at half the diagonal (lensfun's model "pa").
        cos4: natural vignetting, the fourth power of the cosine off the axis.
        polarizer_angle_sd_deg: spread of the analysers' angles between photosites. off_axis: see ``polarization.analyser_axes``.
        supersampling: rays per pixel along each axis, averaged over the pixel's aperture; none: 1 for an instance, whose pixels the field
            learned from, 2 for a virtual sensor.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9_\-]+$")
    description: str = ""
    source: str = Field("", description="where the figures come from")
    instance_of: str | None = None
    measured: tuple[str, ...] = Field((), description="sensor files, beside this one or packaged, whose responses virtual channels use")
    camera: Camera | None = None
    camera_to_reference: tuple[tuple[float, ...], ...] | None = None
    mosaic: tuple[tuple[int, ...], ...] | None = None
    mosaic_offset: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = (0, 0)
    channels: tuple[Channel, ...] = ()
    alignment: Literal["msb", "lsb"] = "msb"
    exposure: float = Field(1.0, gt=0)
    psf_sigma_px: float = Field(0.0, ge=0, le=20)
    vignetting: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cos4: bool = False
    polarizer_angle_sd_deg: float = Field(0.0, ge=0)
    off_axis: OffAxis = "ideal"
    supersampling: int | None = Field(None, ge=1, le=16)
    noise: NoiseModel

    @field_validator("mosaic")
    @classmethod
    def _channels_without_holes(cls, mosaic: tuple[tuple[int, ...], ...] | None) -> tuple[tuple[int, ...], ...] | None:
        if mosaic is not None:
            pattern_of(mosaic)
        return mosaic

    @field_validator("camera_to_reference")
    @classmethod
    def _rigid(cls, matrix: tuple[tuple[float, ...], ...] | None) -> tuple[tuple[float, ...], ...] | None:
        if matrix is None:
            return None
        m = np.array(matrix) if len({len(row) for row in matrix}) == 1 else np.empty(0)
        good = m.shape == (4, 4) and np.isfinite(m).all() and np.allclose(m[3], [0, 0, 0, 1])
        if not good or not np.allclose(m[:3, :3] @ m[:3, :3].T, np.eye(3), atol=1e-4) or np.linalg.det(m[:3, :3]) < 0:
            raise ValueError("expected a rigid 4x4 matrix")
        return matrix

    @model_validator(mode="after")
    def _one_kind(self) -> SensorFile:
        if self.mosaic is not None and self.channels and max(map(max, self.mosaic)) + 1 != len(self.channels):
            raise ValueError(f"mosaic: {max(map(max, self.mosaic)) + 1} channels, but 'channels' has {len(self.channels)}")
        labels = [c.label for c in self.channels]
        if len(set(labels)) < len(labels):
            raise ValueError(f"channels: the labels are {', '.join(labels)}, expected every label once")
        if self.instance_of is None:
            if not self.channels:
                raise ValueError("channels: none, expected some, or the key 'instance_of'")
            for c in self.channels:
                if (c.of is None) == (c.response is None) and not (c.polarizer and c.of is None):
                    raise ValueError(f"channels: {c.label}: expected one of 'of' and 'response'")
            polarized = [c.polarizer is not None for c in self.channels]
            if any(polarized) and not all(polarized):
                raise ValueError("channels: some have a polarizer and some have none, expected all or none")
            if any(c.response is not None for c in self.channels) and not self.measured:
                raise ValueError("measured: missing, expected the files of captured sensors whose channels the responses are made of")
        return self

    @property
    def file_bits(self) -> int:
        """Of the integers in its image files."""
        return 8 if self.noise.bits <= 8 else 16

    @property
    def shift(self) -> int:
        """By how many bits the converter's numbers are moved up in files."""
        return self.file_bits - self.noise.bits if self.alignment == "msb" else 0

    @property
    def dn_at_one(self) -> float:
        """The number [DN] of a pixel whose file reads as 1.0, which is the full scale of its integers."""
        return (2.0**self.file_bits - 1.0) / 2**self.shift

    def light_of(self, value: Any) -> Any:
        """What a frame, or a field that learned from frames, says (1.0 = full scale of the file, black level included) → light (1.0 = full
        scale of the converter above black)."""
        return (value * self.dn_at_one - self.noise.black_dn) / (self.noise.white_dn - self.noise.black_dn)

    @property
    def kind(self) -> Literal["instance", "virtual"]:
        return "virtual" if self.instance_of is None else "instance"


def find_sensor_file(name_or_path: str, beside: Path | None = None) -> Path:
    """A TOML file, sought beside another one first, or a packaged sensor by its name.

    Raises:
        InputError: there is none.
    """
    path = Path(name_or_path)
    for candidate in ([beside / path] if beside is not None else []) + [path]:
        if candidate.suffix and candidate.is_file():
            return candidate
    folder = data_folder("recipes") / "sensors"
    packaged = folder / (path.name if path.suffix else f"{name_or_path}.toml")
    if path.parent == Path(".") and packaged.is_file():
        return packaged
    known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
    raise InputError(f"sensor {name_or_path!r}: not found, expected a TOML file or one of {known}.")


def load_sensor(path: Path) -> SensorFile:
    """Read a sensor file.

    Raises:
        InputError: unreadable file, broken TOML, an unknown key, or a value that cannot be.
    """
    return read_toml(path, SensorFile)


def sensor_to_toml(sensor: SensorFile, comments: tuple[str, ...] = ()) -> str:
    """The file's text; what has its default is left out. ``comments`` stand above it."""
    content: dict[str, Any] = sensor.model_dump(exclude_defaults=True)
    content["noise"] = {k: v for k, v in content["noise"].items() if v != getattr(NoiseModel, k, None)}
    if sensor.camera is not None:
        content["camera"] = {k: v for k, v in content["camera"].items() if v != ()}
    return "".join(f"# {line}\n" for comment in comments for line in comment.splitlines()) + tomli_w.dumps(content)
