"""Cameras: intrinsics and a lens (see ``lenses``), from points to pixels and from pixels to rays.

Pixel coordinates u, v are column and row; the centre of the top-left pixel is (0, 0). ``project_points`` and
``unproject_points`` are batched torch functions, differentiable in every argument (a pose is refined through its points);
``project``, ``unproject`` and ``ray_map`` are the same for one ``Camera`` and NumPy arrays, in float64.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from mmsynth.errors import InputError
from mmsynth.parallel import side_by_side
from mmsynth.sensors import lenses

Lens = Literal["brown_conrady", "kannala_brandt"]
COEFFICIENTS: dict[str, tuple[str, ...]] = {
    "brown_conrady": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "kannala_brandt": ("k1", "k2", "k3", "k4"),
}
"""Their names, in order."""
MAX_SIZE = 1_000_000  # pixels: ten times the largest panoramas
_SMALL = 1 << 18  # pixels: a map of rays of 6.5 MB
_ON_AXIS = 1e-4  # tan θ below which a fisheye's r_d / r is taken from its series: the next term is 1e-16


@dataclass(frozen=True)
class Camera:
    """Intrinsics [px] and lens. Hashable.

    Attributes:
        distortion: Brown-Conrady: 0, 4, 5, 6 or 8 coefficients in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6; Kannala-Brandt: 4, k1 to k4.
        lens: which of the two. Without coefficients ``brown_conrady`` is a pinhole, ``kannala_brandt`` an equidistant fisheye.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    lens: Lens = "brown_conrady"

    def __post_init__(self) -> None:
        if self.lens not in COEFFICIENTS:
            raise InputError(f"camera: lens {self.lens!r}, expected one of {', '.join(COEFFICIENTS)}.")
        fisheye, count = self.lens == "kannala_brandt", len(self.distortion)
        if count not in ((0, 4) if fisheye else (0, 4, 5, 6, 8)):
            expected = "4 of a fisheye: k1 k2 k3 k4" if fisheye else "0, 4, 5, 6 or 8 in the order k1 k2 p1 p2 k3 k4 k5 k6"
            raise InputError(f"distortion: {count} coefficients, expected {expected}.")
        if not (1 <= self.width <= MAX_SIZE and 1 <= self.height <= MAX_SIZE):
            raise InputError(f"camera: size {self.width}x{self.height}, expected at least 1x1 pixel, at most {MAX_SIZE} a side.")
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(np.isfinite(values)) or self.fx <= 0 or self.fy <= 0:
            raise InputError(
                f"camera: fx={self.fx}, fy={self.fy}, cx={self.cx}, cy={self.cy}, expected finite numbers and positive focal lengths."
            )

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) intrinsic matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> np.ndarray:
        """(8,) or, of a fisheye, (4,) distortion, zero-padded."""
        return np.array(self.distortion + (0.0,) * (len(COEFFICIENTS[self.lens]) - len(self.distortion)))

    @property
    def intrinsics(self) -> np.ndarray:
        """(4,) fx, fy, cx, cy."""
        return np.array([self.fx, self.fy, self.cx, self.cy])


def resized(camera: Camera, width: int, margin: int = 0) -> Camera:
    """The same lens and field of view on ``width`` pixels in a row, as square as the camera's own; with a margin on each side [px]."""
    height = max(1, round(camera.height * width / camera.width))
    x, y = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width + 2 * margin,
        height=height + 2 * margin,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=(camera.cx + 0.5) * x - 0.5 + margin,
        cy=(camera.cy + 0.5) * y - 0.5 + margin,
    )


def every_nth(camera: Camera, n: int) -> Camera:
    """The photosites of every n-th row and column, from the first: pixel (i, j) has the ray of pixel (n i, n j)."""
    of = lambda size: -(-size // n)
    return replace(
        camera, width=of(camera.width), height=of(camera.height), fx=camera.fx / n, fy=camera.fy / n, cx=camera.cx / n, cy=camera.cy / n
    )


def project_points(points: Tensor, intrinsics: Tensor, coefficients: Tensor, lens: Lens = "brown_conrady") -> tuple[Tensor, Tensor]:
    """Points in front of cameras → pixels.

    Args:
        points: (..., N, 3) in the camera's axes. intrinsics: (..., 4) fx, fy, cx, cy [px].
        coefficients: (..., 8), or (..., 4) of a fisheye.
    Returns:
        (..., N, 2) pixels and (..., N) bool: whether the lens sees the point, on the near side of its fold. Pixels of others are finite
        and mean nothing.
    """
    x, y, z = points.unbind(-1)
    if lens == "kannala_brandt":
        across = x * x + y * y
        far = (across > (_ON_AXIS * z) ** 2) | ((z < 0) & (across > 0))  # from the axis ahead: what is behind has its angle alone
        radius = torch.sqrt(torch.where(far, across, 1.0))
        angle = torch.atan2(torch.where(far, radius, 0.0), torch.where(far, z, 1.0))
        ahead = torch.where((z > 0) & ~far, z, 1.0)
        tangent2 = across / ahead**2
        near = (1.0 + tangent2 * (coefficients[..., None, 0] - 1.0 / 3.0)) / ahead
        scale = torch.where(far, lenses.fisheye_radius(angle, coefficients) / radius, near)
        distorted = points[..., :2] * scale[..., None]
        valid = torch.where(far, angle <= lenses.fisheye_fold(coefficients)[..., None], z > 0)
    else:
        valid = z > 0
        ideal = points[..., :2] / torch.where(valid, z, 1.0)[..., None]
        valid = valid & (torch.linalg.vector_norm(ideal.detach(), dim=-1) <= lenses.fold_radius(coefficients)[..., None])
        # far behind the fold the polynomial overflows, and its gradient with it
        ideal = torch.where(valid[..., None], ideal, 0.0)
        distorted = lenses.distort(ideal, coefficients)
    return distorted * intrinsics[..., None, :2] + intrinsics[..., None, 2:], valid


def unproject_points(pixels: Tensor, intrinsics: Tensor, coefficients: Tensor, lens: Lens = "brown_conrady") -> tuple[Tensor, Tensor]:
    """Pixels → unit directions in the camera's axes, the inverse of ``project_points``.

    Args:
        pixels: (..., N, 2). intrinsics: (..., 4). coefficients: (..., 8), or (..., 4) of a fisheye.
    Returns:
        (..., N, 3) unit directions and (..., N) bool: whether the lens has a ray there; directions of others point along the axis.
    """
    given = torch.isfinite(pixels).all(-1)
    distorted = (torch.where(given[..., None], pixels, 0.0) - intrinsics[..., None, 2:]) / intrinsics[..., None, :2]
    if lens == "kannala_brandt":
        square = distorted.square().sum(-1)
        away = square > 1e-30
        radius = torch.sqrt(torch.where(away, square, 1.0))
        angle, valid = lenses.fisheye_angle(torch.where(away, radius, 0.0), coefficients)
        valid = valid & given
        # on the axis sin θ / r_d is one, and its gradient is that of the pixel alone
        scale = torch.where(away, torch.sin(angle) / radius, 1.0)
        directions = torch.cat([distorted * scale[..., None], torch.cos(angle)[..., None]], -1)
        return torch.where(valid[..., None], directions, directions.new_tensor([0.0, 0.0, 1.0])), valid
    ideal, valid = lenses.undistort(distorted, coefficients)
    valid = valid & given
    directions = torch.cat([torch.where(valid[..., None], ideal, 0.0), torch.ones_like(ideal[..., :1])], -1)
    return directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True), valid


def _parameters(camera: Camera) -> tuple[Tensor, Tensor, Lens]:
    return torch.from_numpy(camera.intrinsics), torch.from_numpy(camera.coefficients), camera.lens


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Camera-frame points (..., 3) → pixels (..., 2), NaN where the lens sees none: behind the camera or its fold."""
    flat = torch.from_numpy(np.array(points, dtype=np.float64).reshape(-1, 3))
    pixels, valid = project_points(flat, *_parameters(camera))
    return np.where(valid[:, None].numpy(), pixels.numpy(), np.nan).reshape(*np.shape(points)[:-1], 2)


def unproject(pixels: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2) → camera-frame unit directions (..., 3), and a validity mask (...)."""
    shape = np.shape(pixels)[:-1]
    flat = torch.from_numpy(np.array(pixels, dtype=np.float64).reshape(-1, 2))
    directions, valid = unproject_points(flat, *_parameters(camera))
    return directions.numpy().reshape(*shape, 3), valid.numpy().reshape(shape)


def ray_map(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Directions of all photosites in float64, kept for the next call: of many small cameras, or of the last large one.

    Returns:
        (H, W, 3) float64 unit vectors in the camera frame and (H, W) bool validity. Do not write to them: they are shared.
    """
    return (_small_ray_map if camera.width * camera.height <= _SMALL else _large_ray_map)(camera)


def _ray_map(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    directions, valid = np.empty((camera.height, camera.width, 3)), np.empty((camera.height, camera.width), bool)
    rows = max(1, _SMALL // camera.width)  # at a time: the inverse of a lens takes ten times the memory of what it gives

    def of_band(top: int) -> tuple[np.ndarray, np.ndarray]:
        v, u = np.mgrid[top : min(top + rows, camera.height), 0 : camera.width]
        return unproject(np.stack([u, v], -1).astype(np.float64), camera)

    for top, found in side_by_side(of_band, range(0, camera.height, rows)):
        directions[top : top + rows], valid[top : top + rows] = found
    directions.setflags(write=False)
    valid.setflags(write=False)
    return directions, valid


_small_ray_map = functools.lru_cache(maxsize=64)(_ray_map)
_large_ray_map = functools.lru_cache(maxsize=1)(_ray_map)


def rays_of_pixels(camera: Camera, begin: int, end: int, device: torch.device | str = "cpu") -> tuple[Tensor, Tensor]:
    """``ray_map`` of the pixels number ``begin`` to ``end - 1``, row by row, made anew on a device: which have a ray (P,) bool, and the
    unit directions (N, 3) float64 of those N that do."""
    index = torch.arange(begin, end, device=device)
    pixels = torch.stack([index % camera.width, index // camera.width], -1).double()
    intrinsics, coefficients, lens = _parameters(camera)
    directions, valid = unproject_points(pixels, intrinsics.to(device), coefficients.to(device), lens)
    return valid, directions[valid]


def surface_points(camera: Camera, camera_to_world: np.ndarray, depth_ray: np.ndarray) -> np.ndarray:
    """Points that pixels see: depth along the ray (H, W) → (H, W, 3) float64, world, NaN where the depth is (kornia's is for pinholes)."""
    points = ray_map(camera)[0].reshape(-1, 3) @ camera_to_world[:3, :3].T  # of rows of pixels numpy makes many small products
    points *= depth_ray.reshape(-1, 1)
    points += camera_to_world[:3, 3]
    return np.asarray(points.reshape(*depth_ray.shape, 3))


def round_trip_error(camera: Camera, pixels: np.ndarray) -> tuple[float, float]:
    """How well the inverse of the lens model works at pixels (N, 2).

    Returns:
        the largest distance [px] between a pixel and the projection of its ray in float32, as rays are cast (NaN where no pixel has
        one), and the share of pixels that have no ray.
    """
    directions, valid = unproject(pixels, camera)
    back = project(directions[valid].astype(np.float32), camera)
    distance = np.linalg.norm(back - pixels[valid], axis=-1)
    return (float(distance.max()) if valid.any() else float("nan")), float(np.mean(~valid))
