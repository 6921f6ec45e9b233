"""Linear or gamma encoded: pictures whose encoding is known."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmsynth.scene.encoding import by_codes, by_file, by_noise, by_polarization, encoding_of
from mmsynth.scene.image_writers import write_exr, write_png
from mmsynth.scene.scene import Sensor

POL = Sensor("pol", ("0", "45", "90", "135"), (None,) * 4, np.array([[2, 1], [3, 0]]), (0.0, 45.0, 90.0, 135.0))
MONO = Sensor("mono", ("mono",), (None,))
BAYER = Sensor("rgb", ("R", "G", "B"), (None,) * 3, np.array([[1, 2], [0, 1]]))


def polarized(gamma: float, dolp: float, electrons: float = 10_000.0, seed: int = 0, size: int = 256) -> np.ndarray:
    """A raw mosaic of smooth light, whose degree and angle of polarization change over it, in 16 bits."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[0:size, 0:size] / size
    s0, degree, angle = 0.3 + 0.6 * u, dolp * v, 2 * np.pi * (u + v)
    analyser = np.radians(np.array([[90.0, 45.0], [135.0, 0.0]]))[np.arange(size)[:, None] % 2, np.arange(size)[None] % 2]
    light = 0.5 * s0 * (1 + degree * np.cos(2 * (analyser - angle)))
    return np.round(65535 * np.clip(random.poisson(electrons * light) / electrons, 0, 1) ** (1 / gamma)).astype(np.uint16)


@settings(max_examples=25, deadline=None)
@given(gamma=st.sampled_from([1.0, 1.8, 2.2, 2.6]), dolp=st.floats(0.4, 0.9), seed=st.integers(0, 1000))
def test_polarization_tells(gamma: float, dolp: float, seed: int) -> None:
    found = by_polarization(POL, [polarized(gamma, dolp, seed=seed)])
    assert found is not None and found.verdict == ("linear" if gamma == 1 else "gamma encoded"), found


def test_polarization_measures_the_exponent_of_weak_polarization() -> None:
    """The slope is exact to second order in the DoLP; at 0.3 what is left out is 2 %."""
    found = by_polarization(POL, [polarized(2.2, 0.3, 1e6)])
    assert found is not None and abs(float(found.because.split("exponent ")[1].split(" ")[0]) - 2.2) < 0.1


def test_light_without_polarization_does_not_tell() -> None:
    for gamma in (1.0, 2.2):
        assert by_polarization(POL, [polarized(gamma, 0.0)]) is None
    assert by_polarization(MONO, [polarized(1.0, 0.8)]) is None


@pytest.mark.parametrize(("gamma", "verdict"), [(1.0, "linear"), (2.4, "gamma encoded")])
def test_codes_of_a_converter(gamma: float, verdict: str) -> None:
    """All numbers of a 12-bit converter, stored in 16 bits."""
    numbers = np.random.default_rng(0).integers(0, 4096, (300, 300))
    stored = (numbers << 4).astype(np.uint16) if gamma == 1 else np.round(65535 * (numbers / 4095) ** (1 / gamma)).astype(np.uint16)
    found = by_codes([stored])
    assert found is not None and found.verdict == verdict


def test_codes_that_say_nothing() -> None:
    random = np.random.default_rng(0)
    eight = random.integers(0, 256, (200, 200)).astype(np.uint8)
    assert by_codes([eight]) is None
    assert by_codes([eight.astype(np.uint16) * 257]) is None  # a picture of 8 bits in a 16-bit file
    assert by_codes([random.integers(0, 65536, (200, 200)).astype(np.uint16)]) is None
    assert by_codes([np.zeros((50, 50), np.uint16)]) is None
    assert by_codes([eight.astype(np.float32)]) is None


@pytest.mark.parametrize("sensor", [MONO, BAYER], ids=["plain", "mosaic"])
@pytest.mark.parametrize("seed", range(3))
def test_noise_tells_where_it_is_white(sensor: Sensor, seed: int) -> None:
    random = np.random.default_rng(seed)
    ramp = np.linspace(20, 1000, 800)[None] * np.ones((300, 1))
    numbers = np.clip(random.poisson(ramp) + random.normal(0, 2, ramp.shape), 0, 1023) / 1023
    linear = by_noise(sensor, [np.round(65535 * numbers).astype(np.uint16)])
    encoded = by_noise(sensor, [np.round(255 * numbers ** (1 / 2.4)).astype(np.uint8)])
    assert linear is not None and linear.verdict == "linear"
    assert encoded is not None and encoded.verdict != "linear"
    smooth = cv2.GaussianBlur(numbers, (0, 0), 1.0)  # demosaicked, compressed, scaled: no longer white
    assert by_noise(MONO, [np.round(65535 * smooth).astype(np.uint16)]) is None
    assert by_noise(sensor, [np.round(65535 * ramp / 1100).astype(np.uint16)]) is None  # rendered without noise


def test_files_that_say_it(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    for suffix in (".jpg", ".webp"):
        cv2.imwrite(str(tmp_path / f"a{suffix}"), picture)
        found = by_file(tmp_path / f"a{suffix}")
        assert found is not None and found.verdict == "gamma encoded"
    write_exr(tmp_path / "a.exr", {"R": np.ones((8, 8), np.float32)})
    assert by_file(tmp_path / "a.exr").verdict == "linear"  # type: ignore[union-attr]
    write_png(tmp_path / "a.png", picture)
    assert by_file(tmp_path / "a.png") is None
    data = (tmp_path / "a.png").read_bytes()
    for kind, body, verdict in ((b"sRGB", b"\0", "gamma encoded"), (b"gAMA", struct.pack(">I", 45455), "gamma encoded"),
                                (b"gAMA", struct.pack(">I", 100000), "linear")):  # fmt: skip
        chunk = struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        (tmp_path / "b.png").write_bytes(data[:33] + chunk + data[33:])
        found = by_file(tmp_path / "b.png")
        assert found is not None and found.verdict == verdict


def test_the_first_evidence_decides_and_without_any_it_says_so(tmp_path: Path) -> None:
    write_png(tmp_path / "raw.png", polarized(2.2, 0.8))
    assert encoding_of(POL, [tmp_path / "raw.png"]).verdict == "gamma encoded"  # though it is a raw mosaic of 16 bits
    write_png(tmp_path / "dim.png", polarized(1.0, 0.0))
    assert encoding_of(POL, [tmp_path / "dim.png"]).verdict == "linear"
    write_png(tmp_path / "plain.png", np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8))
    found = encoding_of(Sensor("rgb", ("R", "G", "B"), (None,) * 3), [tmp_path / "plain.png"])
    assert found.verdict == "cannot be told" and found.because
