"""``mmsynth bench twin``: what each part of a sensor's twin costs, and how far it is from what it should be.

Effects are judged by closed forms: the variance (or mean, or correlation) that a flat field must have, in the deviations that a sample of
this size may have. Supersampling is judged by the exact mean of a picture over each pixel, and of a fitted field, where one is given.
Self-calibration is judged by figures that are known. To add an effect, add a ``Method`` to its family.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from mmsynth.bench.machine import measure
from mmsynth.bench.methods import REPEATS, Method, chosen_families, family_tables, measured, typical
from mmsynth.bench.output import Report, scatter_panels, write_report
from mmsynth.field.field import Field
from mmsynth.operations.output.progress import Progress
from mmsynth.operations.simulation.frames import render_light
from mmsynth.operations.simulation.plan import SimulatedSensor
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera, resized
from mmsynth.sensors.noise import NoiseModel, record
from mmsynth.sensors.photon_transfer import photon_transfer, photon_transfer_of_frames
from mmsynth.sensors.sensor_file import Response, SensorFile
from mmsynth.sensors.spectral import MEASURED_ERROR, SMOOTH_NM, combine
from mmsynth.sensors.twin import SensorTwin, aperture, blur

_HEIGHT, _WIDTH, _LIGHT = 480, 640, 0.3
_RGGB, _POL = np.array([[0, 1], [1, 2]]), np.array([[2, 1], [3, 0]])
_CAMERA = Camera(_WIDTH, _HEIGHT, 600.0, 600.0, (_WIDTH - 1) / 2, (_HEIGHT - 1) / 2)
_PLAIN = NoiseModel(bits=12, gain_dn_e=0.4, full_well_e=2e4)


# --- effects


def _judged(found: float, truth: float, deviation: float) -> dict[str, float]:
    """A figure against its closed form; ``deviation``: one standard deviation of the figure, by the sample's size."""
    off = abs(found - truth)
    return {"found": found, "truth": truth, "error": off / max(abs(truth), 1e-12), "deviations": off / deviation}


def _variance(raw: Tensor, truth: float, overlap: float = 1.0) -> dict[str, float]:
    """``overlap``: by how much a correlated sample tells less."""
    return _judged(float(raw.double().var()), truth, truth * math.sqrt(2.0 * overlap / raw.numel()))


def effects() -> list[Method]:
    """A flat field of 640 x 480 pixels through one effect of the noise at a time: variance [DN²] against its closed form."""
    light = torch.full((1, _HEIGHT, _WIDTH), _LIGHT)
    k, electrons = _PLAIN.gain_dn_e, _LIGHT * _PLAIN.electrons_at_one
    shot = k * k * electrons + 1.0 / 12.0

    def method(name: str, judge: Callable[[Tensor], dict[str, float]], **figures: float) -> Method:
        model = dataclasses.replace(_PLAIN, **figures)  # type: ignore[arg-type]
        run = functools.partial(record, light, model, [0], "bench")
        return Method("noise of a flat field", name, run, judge, light.numel(), "of the closed form")

    rows = lambda raw: raw[0].double().mean(1)
    neighbours = lambda raw: float(np.corrcoef(raw[0, :, 1:].ravel(), raw[0, :, :-1].ravel())[0, 1])
    c = 0.03
    kept, given = (1 - 4 * c) ** 2 + 4 * c * c, 2 * c * (1 - 4 * c)
    level = _PLAIN.white_dn * _LIGHT
    pattern = (0.02 * level) ** 2
    return [
        method("shot noise", lambda raw: _variance(raw, shot)),
        method("mean", lambda raw: _judged(float(raw.double().mean()), level, math.sqrt(shot / raw.numel()))),
        method("+ read noise, 20 e-", lambda raw: _variance(raw, shot + (k * 20.0) ** 2), read_e=20.0),
        method(
            "+ row noise, 20 e-",
            lambda raw: _judged(float(rows(raw).var()), (k * 20.0) ** 2 + shot / _WIDTH, (k * 20.0) ** 2 * math.sqrt(2 / _HEIGHT)),
            row_e=20.0,
        ),
        method("+ dark current, 400 e-", lambda raw: _variance(raw, shot + k * k * 400.0), dark_e_s=400.0, exposure_s=1.0),
        method("+ DSNU, 30 e-", lambda raw: _variance(raw, shot + k * k * (1000.0 + 900.0)), dark_e_s=1000.0, exposure_s=1.0, dsnu_e=30.0),
        method("+ PRNU, 2 %", lambda raw: _variance(raw, shot + pattern), prnu=0.02),
        method("+ crosstalk, 3 %", lambda raw: _variance(raw, k * k * electrons * kept + 1 / 12, 1.3), crosstalk=c),
        method(
            "+ crosstalk, correlation of neighbours",
            lambda raw: _judged(neighbours(raw), given / kept, 1.2 / math.sqrt(raw.numel())),
            crosstalk=c,
        ),
    ]  # fmt: skip


def optics() -> list[Method]:
    """Light on 640 x 480 pixels through the stages before the noise, each against its closed form."""
    file = lambda **figures: SensorFile.model_validate(
        {"name": "bench", "noise": _PLAIN, "channels": [{"label": "x", "of": "a.x"}], **figures}
    )
    white = torch.randn(1, 1, _HEIGHT, _WIDTH, generator=torch.Generator().manual_seed(0))
    ramp = torch.linspace(0.0, 1.0, 2 * _WIDTH).expand(1, 1, 2 * _HEIGHT, 2 * _WIDTH)
    colours = torch.arange(1.0, 4.0)[:, None, None].expand(1, 3, _HEIGHT, _WIDTH)
    polarizers = [{"label": str(a), "polarizer": {"angle_deg": a, "extinction_ratio": 100.0}} for a in (0.0, 45.0, 90.0, 135.0)]
    stokes = torch.tensor([1.0, 0.3, 0.2])[:, None, None].expand(1, 4, 3, _HEIGHT, _WIDTH)
    vignetting = SensorTwin(file(vignetting=(-0.3, 0.0, 0.0)), _CAMERA, None)
    bayer = SensorTwin(file(channels=[{"label": c, "of": f"a.{c}"} for c in "RGB"]), _CAMERA, _RGGB)
    pol = SensorTwin(file(channels=polarizers), _CAMERA, _POL, analysers=True)
    sigma, size = 1.5, _HEIGHT * _WIDTH

    def correlation(image: Tensor) -> dict[str, float]:
        a, b = image[..., :-2].ravel().double(), image[..., 2:].ravel().double()
        # of blurred white noise at a distance d: exp(-d² / 4 σ²), σ² with the width of a pixel
        return _judged(float((a * b).mean() / (a * a).mean()), math.exp(-1.0 / (sigma**2 + 1 / 12)), 4.0 * sigma / math.sqrt(size))

    exact = lambda found, truth, unit=1e-6: _judged(float(found), truth, unit)
    corner = 1 - 0.3 * ((_WIDTH - 1) ** 2 + (_HEIGHT - 1) ** 2) / (_WIDTH**2 + _HEIGHT**2)
    analysed = 0.5 * (1 + 99 / 101 * 0.3)  # at 0 degrees
    method = lambda name, run, judge: Method("light on the pixels", name, run, judge, size, "of the closed form")
    return [
        method(f"PSF, σ = {sigma} px", lambda: blur(white, sigma), correlation),
        method("aperture, 2 x 2", lambda: aperture(ramp, 2), lambda x: exact(x[0, 0, 0, 100], 100.25 / (_WIDTH - 0.5) * 1.0, 1e-3)),
        method("vignetting", lambda: vignetting.expose(torch.ones(1, 1, _HEIGHT, _WIDTH)), lambda x: exact(x[0, 0, 0, 0], corner)),
        method("mosaic, Bayer", lambda: bayer.expose(colours), lambda x: exact(x[0, 1::2, 1::2].mean(), 3.0)),
        method("analysers and mosaic", lambda: pol.expose(stokes), lambda x: exact(x[0, 1::2, 1::2].mean(), analysed)),
    ]


# --- supersampling


def supersampling() -> list[Method]:
    """Rays per pixel along each axis: a picture of edges and lines against its exact mean over each pixel (by 32 x 32)."""
    picture = lambda s: _star(resized(Camera(80, 60, 50.0, 50.0, 39.5, 29.5), 80 * s))
    sampled = lambda s: aperture(picture(s), s)
    return _sampled("a star of 36 rays", sampled, sampled(32), (1, 2, 3, 4, 8))


def _sampled(problem: str, light: Callable[[int], Tensor], truth: Tensor, samples: Sequence[int]) -> list[Method]:
    """``light`` (..., H, W) by its samples per pixel along each axis."""
    judge = lambda found: typical((found - truth).abs().numpy())
    count = truth.shape[-1] * truth.shape[-2]
    return [Method(problem, f"{s} x {s}", functools.partial(light, s), judge, count, "full scale") for s in samples]


def _star(camera: Camera) -> Tensor:
    """(1, H, W): a Siemens star, black and white, and a disc."""
    y = (torch.arange(camera.height) - camera.cy) / camera.fy
    x = (torch.arange(camera.width) - camera.cx) / camera.fx
    angle, radius = torch.atan2(y[:, None], x), torch.hypot(y[:, None], x)
    return torch.where(radius < 0.15, 0.7, (torch.sin(36.0 * angle) > 0).float())[None]


def of_the_field(field: Field) -> list[Method]:
    """The first sensor of a fitted field, rays per pixel along each axis, against 8 x 8."""
    name = next(iter(field.sensors))
    camera = field.cameras[name]
    pose = np.eye(4)
    pose[:3, 3] = np.array(field.region.centre) - [0.0, 0.0, 3.0 * field.region.radius]
    file = SensorFile.model_validate({"name": name, "instance_of": name, "noise": _PLAIN})

    def light(s: int) -> Tensor:
        own_light = lambda c, _: np.moveaxis(c[name], -1, 0)
        planned = SimulatedSensor(file, field.sensors[name], camera, np.eye(4), (name,), s, False, own_light, {})
        return render_light(field, planned, PosedCamera(camera, pose))

    return _sampled(name, light, light(8), (1, 2, 3, 4))


# --- calibration and spectra


def calibration() -> list[Method]:
    """Noise figures of a simulated sensor from its frames, how far off each is; at best: the Cramér–Rao bound, given the truth."""
    model = NoiseModel(bits=12, gain_dn_e=0.4, full_well_e=1.05e4, read_e=5.0, black_dn=64.0, prnu=0.01)
    lights, models = [], []
    for i in range(4):
        random = np.random.default_rng(i)
        base = gaussian_filter(random.random((200, 260)), 25)
        base = (base - base.min()) / np.ptp(base)
        texture = 3.0 * (gaussian_filter(random.random(base.shape), 1) - 0.5) * (gaussian_filter(random.random(base.shape), 12) > 0.5)
        lights.append(np.clip(0.01 + 0.7 * base**2 * (1.0 + 0.3 * texture), 0.0, 0.9))
        # a model that blurs, and that is two per cent off in places
        models.append(gaussian_filter(lights[-1], 1.2) * (1.0 + 0.14 * gaussian_filter(random.normal(size=base.shape), 2.0)))
    expected = lambda light: model.black_dn + light * (model.white_dn - model.black_dn)

    def method(name: str, count: int, share: int) -> Method:
        light = np.stack(lights[:count]) / share
        raw = record(torch.from_numpy(light), model, range(count), "bench").numpy()
        at_best = _read_bound(expected(light) - model.black_dn, model)

        def of_truth() -> Any:
            return photon_transfer(raw.ravel(), expected(light).ravel(), model.bits, model.black_dn)

        def of_model() -> Any:
            frames = [(r, expected(m / share)[..., None]) for r, m in zip(raw, models, strict=False)]
            return photon_transfer_of_frames(frames, np.zeros((1, 1), np.int64), model.bits, model.black_dn)

        def judge(found: Any) -> dict[str, float]:
            off = lambda figure: abs(getattr(found, figure) / getattr(model, figure) - 1)
            errors = {"gain": off("gain_dn_e"), "read": off("read_e"), "prnu": off("prnu")}
            return {"error": errors["gain"], "worst": max(errors.values()), **errors, "read_at_best": at_best}

        exposed = f"{count} frame{'s' * (count > 1)}, exposure 1/{share}"
        run = of_truth if name == "the truth" else of_model
        return Method(f"from {name}", exposed, run, judge, light.size, "of the figure")

    return [method(name, *case) for name in ("the truth", "a model") for case in ((1, 1), (4, 1), (4, 4), (4, 16))]


def _read_bound(signal: np.ndarray, model: NoiseModel) -> float:
    """Least relative deviation of the read noise, by Fisher's information of normal values with gain, read noise and PRNU unknown.

    Args:
        signal: expected [DN] above black.
    """
    k, signal = model.gain_dn_e, signal.ravel()
    variance = (k * model.read_e) ** 2 + 1.0 / 12.0 + k * signal + (model.prnu * signal) ** 2
    # by K, by the square of the read noise in DN, by the square of the PRNU
    slopes = np.stack([signal, np.ones_like(signal), signal**2], 1) / variance[:, None]
    covariance = np.linalg.inv(0.5 * slopes.T @ slopes)
    # σ_d² = c / K²
    gradient = np.array([-2.0 * model.read_e**2 / k, 1.0 / k**2, 0.0])
    return float(np.sqrt(gradient @ covariance @ gradient) / (2.0 * model.read_e**2))


def spectra() -> list[Method]:
    """A band of 30 nm put together from N measured bands over 400 to 700 nm: error on smooth random spectra, and the expected one."""
    nm = np.arange(400.0, 701.0, 2.0)
    apart = 3.0**0.5 * np.abs(nm[:, None] - nm) / SMOOTH_NM
    random = np.random.default_rng(0)
    smooth = np.linalg.cholesky((1.0 + apart) * np.exp(-apart) + 1e-9 * np.eye(len(nm))) @ random.normal(size=(len(nm), 2000))
    band = lambda centre, width: Response.model_validate({"centre_nm": centre, "fwhm_nm": width})
    wanted = band(560.0, 30.0)
    truth = wanted.at(nm) @ smooth

    def method(count: int) -> Method:
        width = 300.0 / count
        bands = [band(400.0 + width * (i + 0.5), width) for i in range(count)]
        measured_values = np.stack([b.at(nm) for b in bands]) @ smooth
        power = np.sqrt(np.mean(measured_values**2, 1, keepdims=True))
        noisy = measured_values + MEASURED_ERROR * power * random.normal(size=measured_values.shape)

        def judge(found: Any) -> dict[str, float]:
            error = found.weights @ noisy - truth
            relative = float(np.sqrt(np.mean(error**2) / np.mean(truth**2)))
            return {"error": relative, "expected_error": found.residual, "noise_gain": found.noise_gain}

        return Method("30 nm at 560 nm", f"{count} bands", lambda: combine(wanted, bands), judge, 1, "of the value")

    return [method(count) for count in (3, 4, 6, 9, 16, 25)]


FAMILIES = (effects, optics, supersampling, calibration, spectra)


def bench_twin(
    out: Path, field: Field | None = None, only: Sequence[str] | None = None, repeats: int = REPEATS, progress: Progress | None = None
) -> Report:
    """Run all families, or those named in ``only``; with a field, its supersampling too.

    Raises:
        InputError: an unknown name, or ``out`` cannot be written.
    """
    families = {name: family() for name, family in chosen_families(FAMILIES, "twin", only).items()}
    rows = measured(families, repeats, progress)
    if field is not None:
        rows += measured({"of the field": of_the_field(field)}, min(repeats, 3), progress)
    figure = scatter_panels(rows, ("ns", "ns per element"), ("error", "error [{unit}]"), "{problem}: {method}")
    results = {"bench": "twin", "machine": measure(), "rows": rows, "repeats": repeats}
    return write_report(results, family_tables(rows, (*FAMILIES, of_the_field)), figure, out)
