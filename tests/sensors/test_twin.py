"""The sensor's twin against OpenCV, SciPy and closed forms, stage by stage and as a whole."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.sensors.camera import Camera, project, ray_map, resized
from mmsynth.sensors.mosaic import mosaic
from mmsynth.sensors.noise import NoiseModel
from mmsynth.sensors.polarization import OffAxis, analyser_axes, frame_angle, reference_axes, stokes_to_intensities
from mmsynth.sensors.sensor_file import Channel, Polarizer, SensorFile
from mmsynth.sensors.twin import SensorTwin, aperture, blur, vignetting_map

PINHOLE = Camera(40, 30, 30.0, 31.0, 19.5, 14.5)
CURVED = Camera(40, 30, 30.0, 31.0, 20.1, 13.8, (-0.118, 0.092, 0.0006, -0.0009, 0.01, 0.0))
FISHEYE = Camera(40, 30, 15.0, 15.5, 20.1, 13.8, (-0.03, 0.01, -0.004, 0.0006), "kannala_brandt")
RGGB = np.array([[0, 1], [1, 2]])
POL = np.array([[2, 1], [3, 0]])
ANGLES = (0.0, 45.0, 90.0, 135.0)
NOISE = NoiseModel(bits=12, gain_dn_e=0.4, full_well_e=10500.0, read_e=5.0, black_dn=64.0)


def _sensor(count: int = 3, noise: NoiseModel = NOISE, polarizers: tuple[Polarizer, ...] = (), **how: Any) -> SensorFile:
    if polarizers:
        channels = tuple(Channel(label=f"c{i}", polarizer=p) for i, p in enumerate(polarizers))
    else:
        channels = tuple(Channel(label=f"c{i}", of=f"rgb.c{i}") for i in range(count))
    return SensorFile(name="cam", channels=channels, noise=noise, **how)


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _stokes(*shape: int, seed: int = 0) -> Tensor:
    """Physical light (*shape[:-2], 3, H, W): DoLP < 1."""
    s0, p, psi = (_random(*shape, seed=seed + i) for i in range(3))
    return torch.stack([s0, s0 * p * torch.cos(7 * psi), s0 * p * torch.sin(7 * psi)], -3)


# --- the grid


@pytest.mark.parametrize("camera", [PINHOLE, CURVED, FISHEYE])
@pytest.mark.parametrize("s", [1, 2, 3, 5])
def test_fine_pixels_tile_the_pixels(camera: Camera, s: int) -> None:
    """Fine pixel j lies at (j + ½) / s - ½ of the sensor; its ray, in the camera as it was, comes back to that place."""
    fine = resized(camera, s * camera.width)
    assert (fine.width, fine.height) == (s * camera.width, s * camera.height)
    v, u = ((np.mgrid[: fine.height, : fine.width] + 0.5) / s) - 0.5
    directions, valid = ray_map(fine)
    assert valid.mean() > 0.9
    found = project(directions, camera)
    np.testing.assert_allclose(found[valid], np.stack([u, v], -1)[valid], atol=1e-7, rtol=0)
    centres = found.reshape(camera.height, s, camera.width, s, 2).mean((1, 3))
    expected = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1)
    seen = np.isfinite(centres).all(-1)
    np.testing.assert_allclose(centres[seen], expected[seen], atol=1e-7, rtol=0)


@pytest.mark.parametrize("s", [1, 2, 3, 4])
def test_aperture_of_a_ramp_is_the_pixels_centre(s: int) -> None:
    v, u = np.mgrid[: 6 * s, : 8 * s]
    at = lambda x: (x + 0.5) / s - 0.5
    found = aperture(torch.from_numpy(0.3 + 0.02 * at(u) - 0.01 * at(v))[None, None], s)[0, 0]
    rows, columns = np.mgrid[:6, :8]
    np.testing.assert_allclose(found, 0.3 + 0.02 * columns - 0.01 * rows, atol=1e-14, rtol=0)


@pytest.mark.parametrize("s", [2, 3, 5])
def test_aperture_equals_opencv_and_keeps_leading_dimensions(s: int) -> None:
    light = _random(2, 3, 4, 6 * s, 8 * s)
    found = aperture(light, s)
    assert found.shape == (2, 3, 4, 6, 8)
    for i in np.ndindex(2, 3, 4):
        np.testing.assert_allclose(found[i], cv2.resize(light[i].numpy(), (8, 6), interpolation=cv2.INTER_AREA), atol=1e-12)


# --- blur


def _beyond(sigma: float) -> float:
    """What lies beyond 4 σ has of the variance: 2 ∫ x² φ(x / σ) / σ."""
    return 2 * sigma**2 * (4 * math.exp(-8) / math.sqrt(2 * math.pi) + 0.5 * math.erfc(4 / math.sqrt(2)))


def _kernel(sigma: float, size: int = 201) -> Tensor:
    light = torch.zeros(1, 1, size, size, dtype=torch.float64)
    light[..., size // 2, size // 2] = 1.0
    return blur(light, sigma)[0, 0]


@pytest.mark.parametrize("sigma", [0.3, 0.5, 0.8, 2.0, 5.0, 12.0])
def test_kernel_is_the_gaussians_mean_over_each_pixel(sigma: float) -> None:
    """Its variance is σ² + 1/12 (Sheppard), less what lies beyond 4 σ; of narrow ones that of whole numbers drawn so."""
    kernel = _kernel(sigma)
    assert float(kernel.sum()) == pytest.approx(1.0, abs=1e-12) and float(kernel.min()) >= 0
    torch.testing.assert_close(kernel, kernel.T)
    torch.testing.assert_close(kernel, kernel.flip(0))
    at = torch.arange(-100, 101, dtype=torch.float64)
    variance = float((kernel.sum(0) * at**2).sum())
    wave = 2.0 * math.pi * sigma
    # of a rounded normal number, first terms of the Fourier series
    rounded = (
        sigma**2 + 1 / 12 + sum((-1) ** k * (4 * sigma**2 + 1 / (math.pi * k) ** 2) * math.exp(-0.5 * (wave * k) ** 2) for k in (1, 2, 3))
    )
    assert -1e-6 <= rounded - variance <= 1.1 * _beyond(sigma)


@pytest.mark.parametrize("sigma", [3.0, 6.0])
def test_wide_blur_equals_scipys_with_the_pixel_in_it(sigma: float) -> None:
    light = _random(90, 110)
    expected = gaussian_filter(light.numpy(), math.sqrt(sigma**2 + 1 / 12), mode="nearest", truncate=6.0)
    found = blur(light, sigma).numpy()
    # what is cut off beyond 4 σ is 6e-5 of the kernel per axis, of a light between 0 and 1
    np.testing.assert_allclose(found, expected, atol=2e-4, rtol=0)
    assert np.abs(gaussian_filter(light.numpy(), 1.05 * sigma, mode="nearest") - expected).max() > 1e-3  # this would tell


@pytest.mark.parametrize("sigma", [0.0, 0.2, 1.0, 15.0])
def test_blur_keeps_constants_and_total_and_leading_dimensions(sigma: float) -> None:
    flat = torch.full((2, 3, 2, 20, 25), 0.37, dtype=torch.float64)
    torch.testing.assert_close(blur(flat, sigma), flat, atol=1e-13, rtol=0)
    light = _random(2, 3, 20, 25)
    each = torch.stack([torch.stack([blur(c, sigma) for c in b]) for b in light])
    torch.testing.assert_close(blur(light, sigma), each)


def test_no_blur_changes_nothing() -> None:
    light = _random(2, 3, 20, 25)
    assert blur(light, 0.0) is light and aperture(light, 1) is light
    torch.testing.assert_close(blur(light, 1e-3), light, atol=1e-12, rtol=0)


def test_blurred_white_noise_has_the_gaussians_autocorrelation() -> None:
    """Of white noise behind a Gaussian of σ: exp(-d² / (4 σ²))."""
    sigma, margin = 2.0, 10
    noise = torch.randn(600, 600, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inner = blur(noise, sigma)[margin:-margin, margin:-margin]
    square = sigma**2 + 1 / 12
    # a correlation ρ is known to about 1 / √n of n independent patches, of area 4 π σ²
    sd = math.sqrt(4 * math.pi * square / inner.numel())
    assert float(inner.var()) == pytest.approx(1 / (4 * math.pi * square), rel=4 * math.sqrt(2) * sd)
    for d in (1, 2, 4, 6):
        for shifted in (inner[d:] * inner[:-d], inner[:, d:] * inner[:, :-d]):
            assert abs(float(shifted.mean() / inner.var()) - math.exp(-(d**2) / (4 * square))) < 4 * sd


@settings(max_examples=25, deadline=None)
@given(sigma=st.floats(0.05, 4.0), s=st.integers(1, 4), seed=st.integers(0, 99))
def test_blur_and_aperture_keep_the_range_of_light(sigma: float, s: int, seed: int) -> None:
    light = _random(1, 2, 6 * s, 7 * s, seed=seed)
    twin = SensorTwin(_sensor(2, psf_sigma_px=sigma), Camera(7, 6, 9.0, 9.0, 3.0, 2.5), None)
    out = twin.to_pixels(light, s)
    assert out.shape == (1, 2, 6, 7)
    assert float(light.min()) - 1e-12 <= float(out.min()) and float(out.max()) <= float(light.max()) + 1e-12


def test_blur_is_in_pixels_of_the_sensor_whatever_the_supersampling() -> None:
    """Second moment of the image of one pixel's square: σ² of the lens, 1/12 of the square, 1/12 of the aperture, up to the fine grid."""
    for s in (2, 4, 8):
        twin = SensorTwin(_sensor(1, psf_sigma_px=1.5), Camera(41, 41, 40.0, 40.0, 20.0, 20.0), None)
        light = torch.zeros(1, 1, 41 * s, 41 * s, dtype=torch.float64)
        light[..., 20 * s : 21 * s, 20 * s : 21 * s] = 1.0
        image = twin.to_pixels(light, s)[0, 0]
        at = torch.arange(-20, 21, dtype=torch.float64)
        variance = float((image.sum(0) * at**2).sum() / image.sum())
        short = 1.5**2 + 2 / 12 - 1 / (12 * s**2) - variance
        assert -1e-9 <= short <= _beyond(1.5)


# --- vignetting


def test_vignetting_is_lensfuns_pa() -> None:
    camera = Camera(41, 31, 30.0, 30.0, 20.0, 15.0)
    found = vignetting_map(camera, (-0.3, 0.1, -0.05))
    assert found.shape == (31, 41) and found[15, 20] == 1.0
    corner = (20.0**2 + 15.0**2) / (20.5**2 + 15.5**2)  # pixel centres lie half a pixel inside of the corner
    assert found[0, 0] == pytest.approx(1 - 0.3 * corner + 0.1 * corner**2 - 0.05 * corner**3)
    assert found[15, 40] == pytest.approx(1 - 0.3 * (a := 400 / (20.5**2 + 15.5**2)) + 0.1 * a**2 - 0.05 * a**3)
    np.testing.assert_array_equal(found, found[::-1, ::-1])
    np.testing.assert_array_equal(vignetting_map(camera), np.ones((31, 41)))


@pytest.mark.parametrize("camera", [PINHOLE, CURVED, FISHEYE])
def test_natural_vignetting_is_cos4_of_the_ray(camera: Camera) -> None:
    directions, valid = ray_map(camera)
    found = vignetting_map(camera, (-0.2, 0.0, 0.0), cos4=True)
    expected = np.where(valid, np.clip(directions[..., 2], 0, None), 0) ** 4 * vignetting_map(camera, (-0.2, 0.0, 0.0))
    np.testing.assert_allclose(found, expected, atol=1e-14, rtol=0)
    if camera is PINHOLE:
        v, u = np.mgrid[:30, :40]
        square = ((u - 19.5) / 30.0) ** 2 + ((v - 14.5) / 31.0) ** 2
        np.testing.assert_allclose(vignetting_map(camera, cos4=True), (1 + square) ** -2.0, atol=1e-12)


def test_negative_vignetting_is_refused() -> None:
    with pytest.raises(InputError, match="vignetting") as refused:
        SensorTwin(_sensor(1, vignetting=(-1.5, 0.0, 0.0)), PINHOLE, None)
    assert "\n" not in str(refused.value) and str(refused.value).endswith(".")
    vignetting_map(PINHOLE, (-1.0, 0.0, 0.0))  # 0 just beyond the corner


# --- mosaic


@pytest.mark.parametrize("pattern", [RGGB, POL, np.arange(9).reshape(3, 3), np.arange(16).reshape(4, 4)])
def test_each_photosite_has_its_channel(pattern: np.ndarray) -> None:
    count = int(pattern.max()) + 1
    light = _random(2, count, 30, 40)
    out = SensorTwin(_sensor(count), PINHOLE, pattern).expose(light)
    torch.testing.assert_close(out, mosaic(light, pattern), atol=0, rtol=0)
    for v, u in ((0, 0), (0, 1), (1, 0), (5, 7), (29, 39)):
        torch.testing.assert_close(out[:, v, u], light[:, pattern[v % len(pattern), u % len(pattern)], v, u], atol=0, rtol=0)
    for shift in ((1, 0), (0, 1)):
        moved = SensorTwin(_sensor(count), PINHOLE, np.roll(pattern, shift, (0, 1))).expose(light)
        assert (moved != out).double().mean() > 0.4


def test_a_full_channel_sensor_keeps_all_channels() -> None:
    light = _random(2, 3, 30, 40)
    torch.testing.assert_close(SensorTwin(_sensor(3, exposure=2.0), PINHOLE, None).expose(light), 2.0 * light)


# --- analysers


@pytest.mark.parametrize("light", ["unpolarized", "polarized", "mixed"])
@pytest.mark.parametrize("ratio, throughput", [(math.inf, 1.0), (30.0, 0.8)])
def test_analysers_measure_what_stokes_vectors_say(light: str, ratio: float, throughput: float) -> None:
    angles = (10.0, 55.0, 100.0, 145.0)
    file = _sensor(polarizers=tuple(Polarizer(angle_deg=a, extinction_ratio=ratio, throughput=throughput) for a in angles))
    stokes = _stokes(2, 4, 30, 40)
    if light == "unpolarized":
        stokes[:, :, 1:] = 0.0
    elif light == "polarized":
        stokes[:, :, 1:] *= (stokes[:, :, 0] / torch.linalg.vector_norm(stokes[:, :, 1:], dim=2))[:, :, None]
    behind = stokes_to_intensities(stokes.movedim(2, -1), angles, throughput, ratio)  # (B, C, H, W, K)
    expected = torch.stack([behind[:, c, :, :, c] for c in range(4)], 1)
    full = SensorTwin(file, PINHOLE, None, analysers=True).expose(stokes)
    torch.testing.assert_close(full, expected, atol=1e-14, rtol=0)
    raw = SensorTwin(file, PINHOLE, POL, analysers=True).expose(stokes)
    torch.testing.assert_close(raw, mosaic(expected, POL), atol=1e-14, rtol=0)
    if light == "unpolarized":
        torch.testing.assert_close(full, 0.5 * throughput * stokes[:, :, 0])
    if light == "polarized" and ratio == 30.0:
        assert float((full / (throughput * stokes[:, :, 0])).min()) >= 1 / 31 - 1e-9  # what leaks


def test_malus_through_the_twin() -> None:
    """Light at ψ behind an analyser at θ: cos²(θ - ψ)."""
    file = _sensor(polarizers=tuple(Polarizer(angle_deg=a) for a in ANGLES))
    psi = math.radians(30.0)
    stokes = torch.tensor([1.0, math.cos(2 * psi), math.sin(2 * psi)], dtype=torch.float64)[None, None, :, None, None].expand(
        1, 4, 3, 30, 40
    )
    raw = SensorTwin(file, PINHOLE, POL, analysers=True).expose(stokes)[0]
    for (row, column), channel in np.ndenumerate(POL):
        expected = math.cos(math.radians(ANGLES[channel]) - psi) ** 2
        np.testing.assert_allclose(raw[row::2, column::2], expected, atol=1e-14)


def _angles_of(twin: SensorTwin) -> Tensor:
    """What each photosite's analyser stands at, from what it measures of light at two angles [rad, mod π]."""
    light = torch.zeros(2, 4, 3, twin.camera.height, twin.camera.width, dtype=torch.float64)
    light[0, :, 1] = light[1, :, 2] = 1.0
    s1, s2 = twin.expose(light)
    return 0.5 * torch.atan2(s2, s1)


def test_spread_of_angles_belongs_to_the_sensor() -> None:
    camera = Camera(240, 200, 200.0, 200.0, 120.0, 100.0)
    polarizers = tuple(Polarizer(angle_deg=a) for a in ANGLES)
    straight = _angles_of(SensorTwin(_sensor(polarizers=polarizers), camera, POL, analysers=True))
    file = _sensor(polarizers=polarizers, polarizer_angle_sd_deg=2.0)
    found = {seed: SensorTwin(file, camera, POL, seed=seed, analysers=True) for seed in (0, 1)}
    away = {seed: torch.remainder(_angles_of(t) - straight + math.pi / 2, math.pi) - math.pi / 2 for seed, t in found.items()}
    n = 240 * 200
    sd = math.radians(2.0)
    for angles in away.values():
        assert float(angles.std()) == pytest.approx(sd, rel=4 / math.sqrt(2 * n))
        assert abs(float(angles.mean())) < 4 * sd / math.sqrt(n)
        beside = float((angles[:, 1:] * angles[:, :-1]).mean()) / sd**2
        assert abs(beside) < 4 / math.sqrt(n)
    assert abs(float((away[0] * away[1]).mean()) / sd**2) < 4 / math.sqrt(n)  # another seed, another sensor
    again = SensorTwin(file, camera, POL, seed=0, analysers=True)
    assert torch.equal(again.analyser, found[0].analyser)
    other = SensorTwin(file.model_copy(update={"name": "other"}), camera, POL, seed=0, analysers=True)
    assert not torch.equal(other.analyser, found[0].analyser)
    light = _stokes(1, 4, 200, 240)
    quiet = SensorTwin(file.model_copy(update={"noise": NoiseModel(16, 1e-4, 1e12)}), camera, POL, analysers=True)
    frames = quiet(light.expand(2, -1, -1, -1, -1), [3, 9])
    # 6.5e8 electrons: the shot noise is 4e-5 of the light, the analysers' spread 1e-2 and more
    assert float((frames[0] - frames[1]).abs().max()) < 10 * math.sqrt(2 * 65535 * 1e-4) + 2


@pytest.mark.parametrize("model", ["lens", "korger"])
@pytest.mark.parametrize("camera", [PINHOLE, CURVED])
def test_off_axis_analysers_stand_as_their_axes_do(model: OffAxis, camera: Camera) -> None:
    centred = Camera(41, 31, camera.fx, camera.fy, 20.0, 15.0, camera.distortion)
    polarizers = tuple(Polarizer(angle_deg=a) for a in (10.0, 55.0, 100.0, 145.0))
    found, ideal = (
        _angles_of(SensorTwin(_sensor(polarizers=polarizers, off_axis=m), centred, POL, analysers=True)) for m in (model, "ideal")
    )
    turned = torch.remainder(found - ideal + math.pi / 2, math.pi) - math.pi / 2
    directions = torch.from_numpy(ray_map(centred)[0].copy())
    x, z = torch.eye(3, dtype=torch.float64)[[0, 2]]
    for v, u in ((0, 0), (0, 40), (30, 1), (15, 20), (7, 33)):
        ray = directions[v, u][None]
        angle = math.radians((10.0, 55.0, 100.0, 145.0)[POL[v % 2, u % 2]])
        e = analyser_axes(ray, x[None], torch.tensor([angle], dtype=torch.float64), model, z[None])
        axes = reference_axes(ray, x[None])
        expected = torch.remainder(frame_angle(*axes, e) - angle + math.pi / 2, math.pi) - math.pi / 2
        assert float(turned[v, u]) == pytest.approx(float(expected), abs=1e-9)
    assert abs(float(turned[15, 20])) < 1e-12
    assert float(turned[[0, 0, -1, -1], [0, -1, 0, -1]].abs().max()) > math.radians(0.5)  # there is something to see in the corners


def test_spread_and_off_axis_of_a_full_channel_sensor() -> None:
    """Without a mosaic every channel has its own analyser at every pixel."""
    file = _sensor(polarizers=tuple(Polarizer(angle_deg=a) for a in ANGLES), polarizer_angle_sd_deg=3.0, off_axis="korger")
    twin = SensorTwin(file, PINHOLE, None, analysers=True)
    assert twin.expose(_stokes(2, 4, 30, 40)).shape == (2, 4, 30, 40)
    torch.testing.assert_close(twin.analyser[:, 0], torch.full((4, 30, 40), 0.5, dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.vector_norm(twin.analyser[:, 1:], dim=1), torch.full((4, 30, 40), 0.5, dtype=torch.float64))


# --- the whole


@pytest.mark.parametrize("s", [1, 2])
def test_a_flat_field_comes_with_its_mean_and_variance(s: int) -> None:
    """Exposure, vignetting, gain and noise together, at every pixel by itself."""
    camera, frames, level = Camera(60, 50, 60.0, 60.0, 29.5, 24.5), 60, 0.4
    file = _sensor(3, exposure=1.5, vignetting=(-0.5, 0.0, 0.0), psf_sigma_px=0.7)
    light = torch.full((1, 3, 50 * s, 60 * s), level, dtype=torch.float64).expand(frames, -1, -1, -1)
    raw = SensorTwin(file, camera, RGGB)(light, range(frames), s).numpy()
    assert raw.shape == (frames, 50, 60) and (raw == np.rint(raw)).all()
    signal = level * 1.5 * vignetting_map(camera, (-0.5, 0.0, 0.0)) * (4095 - 64)
    variance = 0.4**2 * 25 + 1 / 12 + 0.4 * signal
    z = (raw.mean(0) - 64 - signal) / np.sqrt(variance / frames)
    n = z.size
    assert abs(z.mean()) < 4 / math.sqrt(n) and z.std() == pytest.approx(1.0, rel=4 / math.sqrt(2 * n))
    ratio = raw.var(0, ddof=1) / variance
    assert abs(ratio.mean() - 1) < 4 * math.sqrt(2 / (frames - 1) / n)
    assert np.polyfit(signal.ravel(), ratio.ravel(), 1)[0] * np.ptp(signal) == pytest.approx(0.0, abs=0.06)  # bright and dark alike


def test_black_is_black_and_too_much_is_white() -> None:
    twin = SensorTwin(_sensor(1, NoiseModel(12, 0.4, 2e4, black_dn=64.0)), PINHOLE, None)
    assert (twin(torch.zeros(1, 1, 30, 40), [0]) == 64).all()
    assert (twin(torch.full((1, 1, 30, 40), 5.0), [0]) == 4095).all()


def _grown(light: Tensor, twin: SensorTwin) -> Tensor:
    return twin.expose(twin.to_pixels(light, 2))


@pytest.mark.parametrize("polarized", [False, True])
@pytest.mark.parametrize("pattern", [RGGB, None])
def test_gradients_before_noise(polarized: bool, pattern: np.ndarray | None) -> None:
    camera = Camera(5, 4, 6.0, 6.0, 2.0, 1.5)
    how: dict[str, Any] = {"psf_sigma_px": 0.6, "vignetting": (-0.3, 0.0, 0.0), "exposure": 1.7}
    if polarized:
        how["polarizers"] = tuple(Polarizer(angle_deg=a, extinction_ratio=40.0) for a in ANGLES[:3])
    twin = SensorTwin(_sensor(3, **how), camera, pattern, analysers=polarized)
    light = (_stokes(2, 3, 8, 10) if polarized else _random(2, 3, 8, 10)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: _grown(x, twin), light)


@pytest.mark.parametrize("pattern", [RGGB, None])
def test_gradients_pass_the_rounding_as_they_come(pattern: np.ndarray | None) -> None:
    file = _sensor(3, psf_sigma_px=0.6, exposure=0.5, vignetting=(-0.3, 0.0, 0.0))
    twin = SensorTwin(file, PINHOLE, pattern)
    light = (0.3 + 0.5 * _random(1, 3, 60, 80)).requires_grad_()
    weight = _random(*_grown(light, twin).shape, seed=5)
    (through,) = torch.autograd.grad((weight * twin(light, [0], 2)).sum(), light)
    (before,) = torch.autograd.grad((weight * _grown(light, twin)).sum(), light)
    torch.testing.assert_close(through, (4095 - 64) * before)


@pytest.mark.parametrize("pattern", [RGGB, None])
def test_frames_depend_on_neither_batch_nor_order(pattern: np.ndarray | None) -> None:
    file = _sensor(3, NoiseModel(12, 0.4, 9000.0, 5.0, 64.0, 10.0, 1.0, 2.0, 3.0, 0.01, 0.02), psf_sigma_px=0.5)
    twin = SensorTwin(file, PINHOLE, pattern, seed=3)
    light = _random(4, 3, 60, 80)
    whole = twin(light, [4, 5, 6, 7], 2)
    assert torch.equal(twin(light.flip(0), [7, 6, 5, 4], 2).flip(0), whole)
    assert torch.equal(SensorTwin(file, PINHOLE, pattern, seed=3)(light[2:3], [6], 2), whole[2:3])
    assert (SensorTwin(file, PINHOLE, pattern, seed=4)(light, [4, 5, 6, 7], 2) != whole).double().mean() > 0.5
    assert (twin(light, [0, 1, 2, 3], 2) != whole).double().mean() > 0.5


def test_channels_of_a_full_channel_sensor_have_noise_of_their_own() -> None:
    camera = Camera(200, 150, 100.0, 100.0, 100.0, 75.0)
    raw = SensorTwin(_sensor(3, NoiseModel(12, 0.4, 1e4, 5.0, 64.0, dsnu_e=5.0, prnu=0.02)), camera, None)(
        torch.full((1, 3, 150, 200), 0.4, dtype=torch.float64), [0]
    )[0]
    assert raw.shape == (3, 150, 200)
    correlation = np.corrcoef(raw.reshape(3, -1).numpy())
    assert np.abs(correlation - np.eye(3)).max() < 4 / math.sqrt(150 * 200)


def test_light_of_a_wrong_size_is_refused() -> None:
    plain = SensorTwin(_sensor(3), PINHOLE, RGGB)
    polarized = SensorTwin(_sensor(polarizers=tuple(Polarizer(angle_deg=a) for a in ANGLES)), PINHOLE, POL, analysers=True)
    for shape in ((1, 3, 30, 41), (1, 3, 29, 40), (3, 30, 40), (1, 3, 3, 30, 40), (1, 3, 40, 30)):
        with pytest.raises(ValueError, match="shape"):
            plain.expose(torch.zeros(shape))
    for shape in ((1, 4, 30, 40), (4, 3, 30, 40), (1, 4, 3, 30, 39)):
        with pytest.raises(ValueError, match="shape"):
            polarized.expose(torch.zeros(shape))
    with pytest.raises(ValueError):
        plain(torch.zeros(1, 3, 60, 80), [0])  # twice the size, but no supersampling
    with pytest.raises(ValueError):
        plain(torch.zeros(2, 3, 30, 40), [0])  # two frames, one id


def test_light_that_does_not_fill_whole_pixels_is_refused() -> None:
    twin = SensorTwin(_sensor(3), PINHOLE, RGGB)
    with pytest.raises(ValueError):
        twin(torch.zeros(1, 3, 61, 80), [0], 2)


def test_the_number_of_channels_is_checked() -> None:
    """More channels than the pattern has, or Stokes vectors of four numbers, are not what the sensor is made for."""
    with pytest.raises(ValueError):
        SensorTwin(_sensor(3), PINHOLE, RGGB).expose(torch.zeros(1, 4, 30, 40))
    polarized = SensorTwin(_sensor(polarizers=tuple(Polarizer(angle_deg=a) for a in ANGLES)), PINHOLE, POL, analysers=True)
    with pytest.raises(ValueError):
        polarized.expose(torch.zeros(1, 4, 1, 30, 40))


@pytest.mark.parametrize("polarized", [False, True])
def test_single_and_double_precision_agree_before_noise(polarized: bool) -> None:
    how: dict[str, Any] = {"psf_sigma_px": 0.6, "vignetting": (-0.3, 0.1, 0.0), "exposure": 1.7, "cos4": True}
    if polarized:
        how["polarizers"] = tuple(Polarizer(angle_deg=a, extinction_ratio=40.0) for a in ANGLES)
    twin = SensorTwin(_sensor(4, **how), PINHOLE, POL, analysers=polarized)
    light = _stokes(2, 4, 60, 80) if polarized else _random(2, 4, 60, 80)
    double, single = _grown(light, twin), _grown(light.float(), twin)
    assert double.dtype == torch.float64 and single.dtype == torch.float32
    torch.testing.assert_close(single.double(), double, atol=2e-6, rtol=0)  # some 16 roundings of 2^-24, of light below 1.7
    assert twin(light.float(), [0, 1], 2).dtype == torch.float32
