"""Image files: values, channel order, damage."""

from __future__ import annotations

import dataclasses
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from mmsynth.errors import InputError
from mmsynth.scene.image_writers import write_exr, write_npz, write_png16, write_tiff16
from mmsynth.scene.images import SUFFIXES, check_file, image_size, load_frame, read_image, saturation_level, used_bits
from mmsynth.scene.scene import Frame, Sensor
from mmsynth.sensors.camera import Camera

COLOUR = np.random.default_rng(0).random((6, 5, 3)).astype(np.float32)
MANY = np.random.default_rng(1).random((6, 5, 9)).astype(np.float32)
HALF_STEP = 0.5 / 65535 + 1e-7


@pytest.mark.parametrize("image", [COLOUR, COLOUR[..., 0]], ids=["rgb", "mono"])
def test_png16_round_trip(tmp_path: Path, image: np.ndarray) -> None:
    write_png16(tmp_path / "a.png", image)
    assert read_image(tmp_path / "a.png").dtype == np.float32
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), image, atol=HALF_STEP, rtol=0)


@pytest.mark.parametrize("image", [COLOUR, COLOUR[..., 0], MANY], ids=["rgb", "mono", "nine channels"])
def test_tiff16_round_trip(tmp_path: Path, image: np.ndarray) -> None:
    write_tiff16(tmp_path / "a.tif", image)
    np.testing.assert_allclose(read_image(tmp_path / "a.tif"), image, atol=HALF_STEP, rtol=0)


def test_tiff_planes_become_channels(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.moveaxis(MANY, -1, 0), photometric="minisblack", planarconfig="separate")
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), MANY)


def test_exr_round_trip_orders_names_naturally(tmp_path: Path) -> None:
    write_exr(tmp_path / "a.exr", {name: COLOUR[..., index] * 7 for index, name in enumerate("RGB")})
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), COLOUR * 7)
    write_exr(tmp_path / "b.exr", {f"ms.{index}": np.full((2, 2), index, np.float32) for index in range(11)})
    np.testing.assert_array_equal(read_image(tmp_path / "b.exr")[0, 0], np.arange(11))


def test_npz_and_npy_are_not_scaled_when_float(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", {"data": MANY * 3})
    np.save(tmp_path / "a.npy", (MANY * 65535).astype(np.uint16))
    np.testing.assert_array_equal(read_image(tmp_path / "a.npz"), MANY * 3)
    np.testing.assert_allclose(read_image(tmp_path / "a.npy"), MANY, atol=2 * HALF_STEP)


def test_an_npz_compresses_what_shrinks(tmp_path: Path) -> None:
    """Noise is stored as it is, a picture before nothing is not; all of them come back as they were."""
    noise, alone = np.random.default_rng(2).random((300, 400)).astype(np.float32), np.full((300, 400, 3), np.nan, np.float32)
    alone[100:150, 100:300] = noise[:50, :200, None]
    arrays = {
        "data": noise,
        "alone": alone,
        "turned": noise.T,
        "seen": np.isfinite(alone),
        "names": np.array(["a", "b"]),
        "none": noise[:0],
    }
    write_npz(tmp_path / "a.npz", arrays)
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
    assert entries["data"].compress_size == entries["data"].file_size
    assert all(entries[name].compress_size < 0.5 * entries[name].file_size for name in ("alone", "seen"))
    with np.load(tmp_path / "a.npz", allow_pickle=False) as found:
        assert found.files == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(found[name], array)
    damaged = bytearray((tmp_path / "a.npz").read_bytes())
    damaged[1000] ^= 1  # of what is stored
    (tmp_path / "a.npz").write_bytes(damaged)
    with pytest.raises(InputError, match=r"a\.npz"):
        read_image(tmp_path / "a.npz")


def test_full_scale_is_exactly_one(tmp_path: Path) -> None:
    for dtype in (np.uint8, np.uint16):
        cv2.imwrite(str(tmp_path / "a.png"), np.full((2, 2), np.iinfo(dtype).max, dtype))
        assert (read_image(tmp_path / "a.png") == 1.0).all()


def test_png16_clips_and_writes_nan_as_zero(tmp_path: Path) -> None:
    write_png16(tmp_path / "a.png", np.array([[-1.0, 2.0, np.nan]]))
    assert read_image(tmp_path / "a.png").tolist() == [[0.0, 1.0, 0.0]]


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    """cv2 alone returns the readable part of a truncated PNG or JPEG."""
    write_png16(tmp_path / "a.png", COLOUR)
    cv2.imwrite(str(tmp_path / "a.jpg"), (COLOUR * 255).astype(np.uint8))
    np.save(tmp_path / "a.npy", COLOUR)
    write_npz(tmp_path / "a.npz", {"data": COLOUR})
    write_tiff16(tmp_path / "a.tif", COLOUR)
    for path in sorted(tmp_path.glob("a.*")):
        data = path.read_bytes()
        cut = path.with_name("cut" + path.suffix)
        for length in range(0, len(data), 7):
            cut.write_bytes(data[:length])
            with pytest.raises(InputError, match="cut"):
                read_image(cut)


def test_truncated_exr_is_refused_and_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """OpenEXR prints to standard output, where --json promises one object and nothing else."""
    write_exr(tmp_path / "a.exr", {"Y": COLOUR[..., 0]})
    data = (tmp_path / "a.exr").read_bytes()
    for length in (0, 10, len(data) // 2, len(data) - 3):
        (tmp_path / "a.exr").write_bytes(data[:length])
        with pytest.raises(InputError, match=r"a\.exr"):
            read_image(tmp_path / "a.exr")
    assert capfd.readouterr().out == ""


def test_flipped_bit_in_png_is_found_by_its_checksum(tmp_path: Path) -> None:
    write_png16(tmp_path / "a.png", COLOUR)
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(data)
    for read in (read_image, check_file):
        with pytest.raises(InputError, match="checksum"):
            read(tmp_path / "a.png")


def test_jpeg_end_marker_of_a_thumbnail_does_not_count(tmp_path: Path) -> None:
    encoded = cv2.imencode(".jpg", (COLOUR * 255).astype(np.uint8))[1].tobytes()
    thumbnail = b"\xff\xe1" + (len(encoded) + 2).to_bytes(2, "big") + encoded
    whole = encoded[:2] + thumbnail + encoded[2:]
    (tmp_path / "a.jpg").write_bytes(whole)
    assert read_image(tmp_path / "a.jpg").shape == COLOUR.shape
    (tmp_path / "a.jpg").write_bytes(whole[:-2])
    with pytest.raises(InputError, match="no end marker"):
        read_image(tmp_path / "a.jpg")


def test_nan_pixel_is_named(tmp_path: Path) -> None:
    image = COLOUR.copy()
    image[4, 2, 1] = np.nan
    np.save(tmp_path / "a.npy", image)
    with pytest.raises(InputError, match=r"a\.npy: the pixel in row 4, column 2"):
        read_image(tmp_path / "a.npy")


def test_unknown_type_and_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown image type"):
        read_image(tmp_path / "a.txt")
    with pytest.raises(InputError, match="no such image file"):
        read_image(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", np.zeros((2, 2), np.int32))
    with pytest.raises(InputError, match="int32"):
        read_image(tmp_path / "a.npy")


def test_saturation_of_left_aligned_12_bit_data() -> None:
    codes = np.arange(4096, dtype=np.uint16) << 4
    assert used_bits(codes) == 12
    assert np.count_nonzero(codes / 65535 >= saturation_level(codes)) == 9
    assert used_bits(np.full(4, 65535, np.uint16)) == 16
    assert used_bits(np.full(4, 0x8000, np.uint16)) == 16  # one bit in use: too plain to tell
    assert saturation_level(np.ones(3, np.float32)) == np.inf
    bytes_ = np.arange(256, dtype=np.uint8)
    assert np.count_nonzero(bytes_ / 255 >= saturation_level(bytes_)) == 1


def _frame(path: Path) -> Frame:
    return Frame("rgb", 0, path, Camera(5, 6, 5.0, 5.0, 2.0, 2.0), np.eye(4))


def test_load_frame_splits_alpha_and_checks_shapes(tmp_path: Path) -> None:
    rgb = Sensor("rgb", ("R", "G", "B"), (None,) * 3)
    rgba = (np.dstack([COLOUR, COLOUR[..., :1]]) * 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA))
    pixels, alpha = load_frame(rgb, _frame(tmp_path / "a.png"))
    np.testing.assert_array_equal(pixels, rgba[..., :3].astype(np.float32) / 255)
    assert alpha is not None
    np.testing.assert_array_equal(alpha, rgba[..., 3].astype(np.float32) / 255)
    raw = dataclasses.replace(rgb, mosaic=np.array([[1, 2], [0, 1]]))
    with pytest.raises(InputError, match="mosaicked"):
        load_frame(raw, _frame(tmp_path / "a.png"))
    write_png16(tmp_path / "b.png", COLOUR[..., 0])
    assert load_frame(raw, _frame(tmp_path / "b.png"))[0].shape == (6, 5)
    assert load_frame(Sensor("mono", ("mono",), (None,)), _frame(tmp_path / "b.png"))[0].shape == (6, 5, 1)
    with pytest.raises(InputError, match="1 channels, expected 3"):
        load_frame(rgb, _frame(tmp_path / "b.png"))
    write_png16(tmp_path / "c.png", COLOUR[:, :4])
    with pytest.raises(InputError, match="is 4x6 pixels, expected 5x6"):
        load_frame(rgb, _frame(tmp_path / "c.png"))


def test_nothing_is_left_behind_when_a_writer_refuses(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one or three channels"):
        write_png16(tmp_path / "a.png", MANY)
    (tmp_path / "a.exr").mkdir()
    with pytest.raises(InputError, match="could not be written"):
        write_exr(tmp_path / "a.exr", {"Y": COLOUR[..., 0]})
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


BYTES = (COLOUR * 255).astype(np.uint8)
LARGE = np.random.default_rng(2).random((48, 40, 3)).astype(np.float32)  # JPEG 2000 needs more than a few pixels
LARGE_BYTES = (LARGE * 255).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".webp", ".bmp", ".ppm", ".ras", ".jp2", ".png", ".apng"])
@pytest.mark.parametrize("channels", [3, 4])
def test_what_opencv_writes_without_loss_is_read(tmp_path: Path, suffix: str, channels: int) -> None:
    if channels == 4 and suffix in (".ppm", ".ras", ".jp2"):
        pytest.skip("has no alpha")
    alpha = np.maximum(LARGE_BYTES[..., :1], 1)  # WebP forgets colours that cannot be seen
    image = np.dstack([LARGE_BYTES, alpha])[..., :channels]
    file = tmp_path / f"a{suffix}"
    quality = {".webp": [cv2.IMWRITE_WEBP_QUALITY, 101], ".jp2": [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, 1000]}.get(suffix, [])
    cv2.imwrite(str(file), image[..., [2, 1, 0, 3][:channels]], quality)
    np.testing.assert_array_equal(np.rint(read_image(file) * 255), image)
    check_file(file)
    assert image_size(file) == (40, 48)


@pytest.mark.parametrize("suffix", [".hdr", ".pfm"])
def test_float_files_are_not_scaled(tmp_path: Path, suffix: str) -> None:
    cv2.imwrite(str(tmp_path / f"a{suffix}"), COLOUR[..., ::-1] * 7)
    np.testing.assert_allclose(read_image(tmp_path / f"a{suffix}"), COLOUR * 7, atol=0.06 if suffix == ".hdr" else 0)
    assert image_size(tmp_path / f"a{suffix}") == (5, 6)


@pytest.mark.parametrize("suffix", [".webp", ".bmp", ".dib", ".ppm", ".pgm", ".pfm", ".hdr", ".ras", ".jp2", ".gif", ".avif"])
def test_a_part_of_any_file_is_refused_without_noise(tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]) -> None:
    image = (LARGE if suffix in (".hdr", ".pfm") else LARGE_BYTES)[..., 0 if suffix == ".pgm" else slice(None)]
    try:
        cv2.imwrite(str(tmp_path / f"a{suffix}"), image)
    except cv2.error:
        pytest.skip("not in this build of OpenCV")
    data = (tmp_path / f"a{suffix}").read_bytes()
    for length in {*range(0, len(data), max(1, len(data) // 12)), len(data) - 1}:
        (tmp_path / f"a{suffix}").write_bytes(data[:length])
        for read in (read_image, check_file):
            with pytest.raises(InputError, match=rf"a\{suffix}: "):
                read(tmp_path / f"a{suffix}")
    assert capfd.readouterr() == ("", "")


def test_every_type_that_opencv_reads_has_its_suffix() -> None:
    """jpe, tif and exr beside them; a mosaic in a video is none."""
    known = {
        ".bmp",
        ".dib",
        ".jpg",
        ".jpeg",
        ".jpe",
        ".jp2",
        ".png",
        ".webp",
        ".avif",
        ".pbm",
        ".pgm",
        ".ppm",
        ".pnm",
        ".pfm",
        ".sr",
        ".ras",
    }
    assert known | {".tif", ".tiff", ".exr", ".hdr", ".pic", ".gif"} <= set(SUFFIXES)


def test_grey_pictures_stored_as_colour(tmp_path: Path) -> None:
    """Lossy compression leaves some codes between the channels; a coloured picture is still refused."""
    nir, camera = Sensor("nir", ("nir",), (None,)), Camera(5, 6, 5.0, 5.0, 2.0, 2.0)
    grey = np.dstack([BYTES[..., 0] // 2] * 3)
    for spread, channels in ((0, 3), (0, 4), (9, 3), (9, 4)):
        image = np.dstack([grey, BYTES[..., :1]])[..., :channels].copy()
        image[2, 3, 1] += spread
        cv2.imwrite(str(tmp_path / "a.png"), image)
        pixels, alpha = load_frame(nir, Frame("nir", 0, tmp_path / "a.png", camera, np.eye(4)))
        np.testing.assert_allclose(pixels[..., 0], image[..., :3].mean(2) / 255, atol=1e-6)
        assert (alpha is not None) == (channels == 4)
    cv2.imwrite(str(tmp_path / "a.png"), BYTES)
    with pytest.raises(InputError, match="3 channels, expected 1"):
        load_frame(nir, Frame("nir", 0, tmp_path / "a.png", camera, np.eye(4)))
