"""``mmsynth bench numerics``: speed against error of what is computed approximately, ours beside the usual ways.

Each family compares methods on problems whose exact answer is known: by construction, by the forward model, or in float64. To add a
method, add a ``Method`` to its family.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import kornia
import numpy as np
import torch
from torch import Tensor

from mmsynth.bench.machine import measure
from mmsynth.bench.methods import REPEATS, Method, chosen_families, family_tables, measured, typical
from mmsynth.bench.output import Report, scatter_panels, write_report
from mmsynth.field.kernels import reference
from mmsynth.operations.output.progress import Progress
from mmsynth.sensors import lenses
from mmsynth.sensors.camera import Camera, unproject
from mmsynth.sensors.mosaic import demosaic, demosaic_edge_aware, mosaic
from mmsynth.sensors.polarization import (
    angle_of_linear_polarization,
    aolp_difference,
    degree_of_linear_polarization,
    intensities_to_stokes,
    stokes_to_intensities,
)

_RGGB = np.array([[0, 1], [1, 2]])
_POL, _POL_ANGLES = np.array([[2, 1], [3, 0]]), (0.0, 45.0, 90.0, 135.0)


# ------------------------------------------------------------------------------------------------------------------- the families


def undistortion() -> list[Method]:
    """Pixels to rays of a lens, judged by OpenCV's forward model [px at f = 1000]. Missing: has no ray, or the method gave none.
    Error: the median. Wrong: by more than 0.1 px, or behind the fold."""
    cases = ((-0.1, 0.02, 60.0), (-0.28, 0.07, 95.0), (0.4, 0.0, 95.0), (-0.35, 0.0, 120.0))
    return [method for case in cases for method in _undistortion(*case)]


def _undistortion(k1: float, k2: float, degrees: float) -> list[Method]:
    focal = 160 / math.tan(math.radians(degrees / 2))
    camera = Camera(321, 241, focal, focal, 160.0, 120.0, (k1, k2, 1e-3, -5e-4))
    pixels = np.stack(np.meshgrid(np.arange(321.0), np.arange(241.0)), -1).reshape(-1, 2)
    matrix, k, lens = camera.matrix, camera.coefficients, torch.from_numpy(camera.coefficients)
    plane = torch.from_numpy((pixels - [160.0, 120.0]) / focal)

    def opencv(iterations: int) -> np.ndarray:
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, iterations, 1e-12)
        return cv2.undistortPoints(pixels[:, None], matrix, k, criteria=criteria)[:, 0]

    def by_kornia() -> np.ndarray:
        return kornia.geometry.calibration.undistort_points(plane[None], torch.eye(3).double()[None], lens[None])[0].numpy()

    def newton() -> np.ndarray:
        point = plane.clone()
        for _ in range(10):
            off = (plane - lenses.distort(point, lens))[..., None]
            step, singular = torch.linalg.solve_ex(lenses.distort_jacobian(point, lens), off)
            point = torch.where((singular == 0)[:, None], point + step[..., 0], point)
        return point.numpy()

    def ours() -> np.ndarray:
        directions, valid = unproject(pixels, camera)
        return np.where(valid[:, None], directions[:, :2] / directions[:, 2:], np.nan)

    def judge(ideal: np.ndarray) -> dict[str, float]:
        given = np.isfinite(ideal).all(-1)
        points = np.concatenate([ideal[given], np.ones((given.sum(), 1))], 1)
        back = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, k)[0][:, 0]
        error = np.nan_to_num(np.linalg.norm(back - pixels[given], axis=1) * 1000 / matrix[0, 0], nan=np.inf)
        # beyond the fold a residual may be small by chance, on the wrong branch
        wrong = (error > 0.1) | (np.linalg.norm(ideal[given], axis=1) > float(lenses.fold_radius(lens)))
        shares = {"wrong": float(wrong.mean()), "missing": float(1 - given.mean())}
        return {"error": float(np.median(error)), "worst": float(error.max()), **shares}

    problem = f"{degrees:.0f}°, k1 = {k1:g}, k2 = {k2:g}"
    ways: dict[str, Callable[[], np.ndarray]] = {
        **{f"OpenCV, {n} iterations": functools.partial(opencv, n) for n in (5, 20, 100)},
        "kornia, 5 iterations": by_kornia,
        "Newton, 10 steps, unchecked": newton,
        "mmsynth": ours,
    }
    return [Method(problem, name, run, judge, len(pixels), "px") for name, run in ways.items()]


def opacity() -> list[Method]:
    """Opacity of sections of a ray, by SDF at their ends, judged in float64."""
    methods = []
    random = torch.Generator().manual_seed(0)
    for s in (64.0, 512.0, 1e4):
        lines = {
            "1024 sections of empty space": torch.full((1025,), 0.3),
            "through a surface": (24.0 - torch.arange(48.0)) * 2.0 / s,
            "one section deep inside": torch.tensor([-0.05, -0.05 - 1.0 / s]),
        }
        for problem, line in lines.items():
            sdf = line + 0.01 / s * torch.rand(64, len(line), generator=random)
            methods += _opacity(f"{problem}, s = {s:g}", sdf, s)
    return methods


def _opacity(problem: str, sdf: Tensor, s: float) -> list[Method]:
    density = torch.nn.functional.softplus(-s * sdf.double())
    exact = 1 - torch.exp(-torch.relu(density[:, 1:] - density[:, :-1]).sum(1))

    def ours(dtype: torch.dtype) -> Tensor:
        before, after = sdf[:, :-1].to(dtype), sdf[:, 1:].to(dtype)
        tau = reference.section_depth(before, after, s, torch.zeros_like(before, dtype=torch.bool))
        return -torch.expm1(-tau.sum(1))

    def neus(dtype: torch.dtype) -> Tensor:
        f = torch.sigmoid(sdf.to(dtype) * s)
        alpha = ((f[:, :-1] - f[:, 1:] + 1e-5) / (f[:, :-1] + 1e-5)).clamp(0, 1)
        through = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha + 1e-7], 1), 1)
        return (alpha * through[:, :-1]).sum(1)

    judge = lambda found: typical((found.double() - exact).abs().numpy())
    kinds = [("NeuS, 1e-5, ", neus, (torch.float32, torch.float16)), ("mmsynth, ", ours, (torch.float32, torch.float64))]
    return [
        Method(problem, f"{name}{_bare(dtype)}", functools.partial(way, dtype), judge, sdf.numel(), "1")
        for name, way, dtypes in kinds
        for dtype in dtypes
    ]


def _bare(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def normals() -> list[Method]:
    """Normals by finite differences of the distance to a sphere of radius 0.6, whose values were rounded to a type."""
    generator = torch.Generator().manual_seed(0)
    outward = torch.nn.functional.normalize(torch.randn(20000, 3, generator=generator, dtype=torch.float64), dim=1)
    points = 0.65 * outward  # where the distance is 0.05
    taps = torch.tensor([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], dtype=torch.float64)

    def four_taps(epsilon: float, dtype: torch.dtype) -> Tensor:
        at = points[:, None] + taps * (epsilon / 3**0.5)
        return (at.norm(dim=-1) - 0.6).to(dtype).double() @ taps

    def central(epsilon: float, dtype: torch.dtype) -> Tensor:
        at = points[:, None, None] + epsilon * torch.stack([torch.eye(3), -torch.eye(3)], 1).double()
        f = (at.norm(dim=-1) - 0.6).to(dtype).double()
        return f[..., 0] - f[..., 1]

    def judge(found: Tensor) -> dict[str, float]:
        angle = torch.atan2(torch.linalg.cross(found, outward).norm(dim=1), (found * outward).sum(1))
        return typical(torch.rad2deg(angle).numpy())

    return [
        Method(
            f"step {epsilon:.2g}",
            f"{kind}, {_bare(dtype)}" + (" (mmsynth)" if way is four_taps and dtype == torch.float32 else ""),
            functools.partial(way, epsilon, dtype),
            judge,
            len(points),
            "°",
        )
        for epsilon in (1 / 64, 1 / 256, 1 / 1024, 1 / 4096)
        for kind, way in (("4 taps", four_taps), ("6 taps", central))
        for dtype in (torch.float32, torch.float16, torch.bfloat16)
    ]


def angles() -> list[Method]:
    """The angle between two unit vectors, in float32."""
    generator = torch.Generator().manual_seed(0)
    draw = lambda: torch.randn(20000, 3, generator=generator, dtype=torch.float64)
    a = torch.nn.functional.normalize(draw(), dim=1)
    aside = torch.nn.functional.normalize(torch.linalg.cross(a, draw()), dim=1)
    ways: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
        "acos, clamped by 1e-6": lambda x, y: torch.acos((x * y).sum(1).clamp(-1 + 1e-6, 1 - 1e-6)),
        "atan2 (mmsynth)": lambda x, y: torch.atan2(torch.linalg.cross(x, y).norm(dim=1), (x * y).sum(1)),
    }
    methods = []
    for size in (1e-5, 1e-3, 0.5, math.pi - 1e-4):
        b = math.cos(size) * a + math.sin(size) * aside
        judge = lambda found, size=size: typical(np.degrees((found.double() - size).abs().numpy()))
        for name, way in ways.items():
            methods.append(Method(f"{size:.5g} rad", name, functools.partial(way, a.float(), b.float()), judge, len(a), "°"))
    return methods


def _picture(height: int, width: int, channels: int) -> np.ndarray:
    """(C, H, W) in [0, 1]: shading, texture and edges in all directions, box-filtered as by pixels."""
    fine = 4
    v, u = np.mgrid[: height * fine, : width * fine] / fine
    out = np.empty((channels, height, width), np.float32)
    for c in range(channels):
        rings = 0.5 + 0.5 * np.sin(((u - 0.6 * width) ** 2 + (v - 0.4 * height) ** 2) / (3.0 * width) + 0.3 * c)
        planes = np.where(np.sin(u / 9 + c) + np.cos(v / 7 - 0.5 * u / 9) > 0.3, 1.0, 0.45)
        value = (0.15 + 0.6 * rings * planes) * (1.0 - 0.15 * c / channels)
        out[c] = value.reshape(height, fine, width, fine).mean((1, 3))
    return out


def demosaicking() -> list[Method]:
    """All channels from a mosaic, against the picture that it was taken of; of polarization also the false DoLP of unpolarized light."""
    image = torch.from_numpy(_picture(240, 320, 3))
    raw = mosaic(image, _RGGB)
    codes = np.round(raw.numpy() * 65535).astype(np.uint16)

    def judge(found: Any) -> dict[str, float]:
        error = np.abs(np.asarray(found, dtype=np.float64) - image.numpy())[:, 4:-4, 4:-4]
        return typical(error) | {"psnr": -20 * math.log10(float(np.sqrt(np.mean(error**2))))}

    of_colours: dict[str, Callable[[], Any]] = {
        "mmsynth, normalised convolution": lambda: demosaic(raw, _RGGB),
        "mmsynth, edge-aware (OpenCV's)": lambda: demosaic_edge_aware(raw.numpy(), _RGGB),
        "OpenCV, bilinear": lambda: np.moveaxis(cv2.demosaicing(codes, cv2.COLOR_BayerBG2RGB) / 65535.0, -1, 0),
        "kornia, bilinear": lambda: kornia.color.raw_to_rgb(raw[None, None], kornia.color.CFA.BG)[0],
    }

    light = torch.from_numpy(_picture(240, 320, 1))[0]
    unpolarized = torch.stack([2 * light, 0 * light, 0 * light], -1)
    frame = mosaic(stokes_to_intensities(unpolarized, _POL_ANGLES).movedim(-1, 0), _POL)

    def superpixels() -> Tensor:
        blocks = frame.reshape(120, 2, 160, 2).permute(0, 2, 1, 3).reshape(120, 160, 4)
        return blocks[..., [3, 1, 0, 2]]  # the pattern's channels in order

    def false_degree(found: Tensor) -> dict[str, float]:
        return typical(degree_of_linear_polarization(intensities_to_stokes(found, _POL_ANGLES)).numpy()[2:-2, 2:-2])

    of_degrees: dict[str, Callable[[], Any]] = {
        "mmsynth, normalised convolution": lambda: demosaic(frame, _POL).movedim(0, -1),
        "superpixels of 2 x 2": superpixels,
    }
    return [
        *(Method("Bayer", name, run, judge, raw.numel(), "1") for name, run in of_colours.items()),
        *(Method("false DoLP of unpolarized light", name, run, false_degree, frame.numel(), "1") for name, run in of_degrees.items()),
    ]


def resampling() -> list[Method]:
    """A picture of polarization at twice its resolution: AoLP across all angles, judged where DoLP is 0.5."""
    psi = lambda n: 180.0 * torch.from_numpy(np.add.outer((np.arange(n) + 0.5) / n, 2 * (np.arange(n) + 0.5) / n))
    small, truth = psi(64), psi(128)
    stokes = torch.stack([torch.ones_like(small), 0.5 * torch.cos(torch.deg2rad(2 * small)), 0.5 * torch.sin(torch.deg2rad(2 * small))], -1)
    aolp = angle_of_linear_polarization(stokes)

    def resize(images: Tensor, mode: str) -> Tensor:
        return torch.nn.functional.interpolate(images[None], scale_factor=2, mode=mode, align_corners=False)[0]

    def judge(found: Tensor) -> dict[str, float]:
        return typical(aolp_difference(found, truth).abs().numpy()[4:-4, 4:-4])

    of_angles = lambda mode: resize(aolp[None], mode)[0]
    of_stokes = lambda mode: angle_of_linear_polarization(resize(stokes.movedim(-1, 0), mode).movedim(0, -1))
    return [
        Method(mode, name, functools.partial(way, mode), judge, truth.numel(), "°")
        for mode in ("bilinear", "bicubic")
        for name, way in (("of angles", of_angles), ("of Stokes vectors (mmsynth)", of_stokes))
    ]


FAMILIES = (undistortion, opacity, normals, angles, demosaicking, resampling)


# ------------------------------------------------------------------------------------------------------------------- the bench


def bench_numerics(out: Path, only: Sequence[str] | None = None, repeats: int = REPEATS, progress: Progress | None = None) -> Report:
    """Run all families, or those named in ``only``.

    Raises:
        InputError: an unknown name, or ``out`` cannot be written.
    """
    families = {name: family() for name, family in chosen_families(FAMILIES, "numerics", only).items()}
    rows = measured(families, repeats, progress)
    figure = scatter_panels(rows, ("ns", "ns per element"), ("worst", "worst error [{unit}]"), "{method}", ours="mmsynth")
    results = {"bench": "numerics", "machine": measure(), "rows": rows, "repeats": repeats}
    return write_report(results, family_tables(rows, FAMILIES), figure, out)
