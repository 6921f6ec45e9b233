"""The digital twin of a sensor: light on its pixels → the raw frame that it would have recorded.

Stages, in this order: blur of the lens (PSF), the pixel's aperture (light comes on a grid ``supersampling`` times finer than the pixels
and is averaged), exposure and vignetting, mosaic, analyser, then ``noise.record``: pattern of the response, shot noise of light and dark
current, crosstalk, read and row noise, full well, gain, black level, rounding.

Light is linear, 1.0 = full scale. Everything up to the rounding is differentiable, the rounding passes gradients as they come.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from mmsynth.errors import InputError
from mmsynth.sensors.camera import Camera, ray_map
from mmsynth.sensors.mosaic import channel_map
from mmsynth.sensors.noise import generator, record
from mmsynth.sensors.polarization import analyser_axes, analyser_matrix, frame_angle, reference_axes
from mmsynth.sensors.sensor_file import SensorFile


def blur_radius(sigma: float) -> int:
    """How far a blur reaches, in pixels of the grid."""
    return math.ceil(4.0 * sigma)


def blur(light: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of (..., H, W), ``sigma`` in pixels of the grid, the border repeated."""
    if sigma == 0.0:
        return light
    from kornia.filters import filter2d_separable  # a second to import

    radius = blur_radius(sigma)
    at = torch.arange(-radius, radius + 1, dtype=light.dtype, device=light.device)
    # the mean of the Gaussian over each pixel: kornia's samples it, which is 0.15 of full scale off at sigma = 0.3
    edges = torch.special.erf((torch.cat([at - 0.5, at[-1:] + 0.5])) / (sigma * 2.0**0.5))
    kernel = edges.diff() / (edges[-1] - edges[0])
    flat = light.reshape(-1, 1, *light.shape[-2:])
    return filter2d_separable(flat, kernel[None], kernel[None], border_type="replicate").reshape(light.shape)


def aperture(light: Tensor, supersampling: int) -> Tensor:
    """(..., sH, sW) → (..., H, W): the mean over each pixel, whose aperture is its whole square.

    Raises:
        ValueError: light that does not fill whole pixels.
    """
    if supersampling == 1:
        return light
    if light.shape[-2] % supersampling or light.shape[-1] % supersampling:
        raise ValueError(f"light of shape {tuple(light.shape)} does not fill whole pixels of {supersampling} x {supersampling}")
    flat = light.reshape(-1, 1, *light.shape[-2:])
    mean = nn.functional.avg_pool2d(flat, supersampling)
    return mean.reshape(*light.shape[:-2], *mean.shape[-2:])


def vignetting_map(camera: Camera, coefficients: Sequence[float] = (0.0, 0.0, 0.0), cos4: bool = False) -> np.ndarray:
    """(H, W) transmittance: 1 + k1 r² + k2 r⁴ + k3 r⁶ (lensfun's "pa"; r = 1 at half the diagonal, from the principal point), times
    cos⁴ of the angle off the axis (of a pixel without a ray: 0).

    Raises:
        InputError: it is negative somewhere.
    """
    v, u = np.mgrid[: camera.height, : camera.width]
    square = ((u - camera.cx) ** 2 + (v - camera.cy) ** 2) / (0.25 * (camera.width**2 + camera.height**2))
    k1, k2, k3 = coefficients
    out = 1.0 + square * (k1 + square * (k2 + square * k3))
    if out.min() < 0:
        raise InputError(f"vignetting: {tuple(coefficients)} is negative towards a corner ({out.min():.2g}), expected a transmittance.")
    if cos4:
        directions, valid = ray_map(camera)
        out = out * np.where(valid, np.clip(directions[..., 2], 0.0, None), 0.0) ** 4
    return np.asarray(out)


class SensorTwin(nn.Module):
    """A sensor as a function from light to raw frames.

    Args:
        sensor: its figures. camera: size, intrinsics and lens. mosaic: (k, k') pattern, as of pixel (0, 0); None: full-channel frames.
        seed: of all that is random. analysers: whether light comes as Stokes vectors and passes the polarizers of the file.
    Raises:
        InputError: vignetting below zero.
    """

    vignetting: Tensor
    channel: Tensor
    analyser: Tensor

    def __init__(self, sensor: SensorFile, camera: Camera, mosaic: np.ndarray | None, seed: int = 0, analysers: bool = False) -> None:
        super().__init__()
        self.sensor, self.camera, self.mosaic, self.seed, self.analysers = sensor, camera, mosaic, seed, analysers
        self.register_buffer("vignetting", torch.from_numpy(vignetting_map(camera, sensor.vignetting, sensor.cos4)))
        pattern = np.zeros((1, 1), np.int64) if mosaic is None else mosaic
        self.register_buffer("channel", torch.from_numpy(channel_map(pattern, camera.height, camera.width)))
        self.register_buffer("analyser", self._analyser_map() if analysers else torch.empty(0))

    def _analyser_map(self) -> Tensor:
        """(3, H, W) or, without mosaic, (C, 3, H, W): what of S0, S1, S2 a photosite measures."""
        polarizers = [c.polarizer for c in self.sensor.channels]
        # without a polarizer: angle, throughput and extinction ratio of no analyser
        figures = [(p.angle_deg, p.throughput, p.extinction_ratio) if p else (0.0, 1.0, 1.0) for p in polarizers]
        angle, passed, ratio = torch.tensor(figures, dtype=torch.float64).T
        # per photosite, or per channel everywhere
        which = self.channel if self.mosaic is not None else torch.arange(len(polarizers))[:, None, None].expand(-1, *self.channel.shape)
        angles = torch.deg2rad(angle)[which]
        if self.sensor.polarizer_angle_sd_deg:
            random = generator(self.seed, self.sensor.name, "polarizer angle")
            angles = angles + math.radians(self.sensor.polarizer_angle_sd_deg) * torch.randn(angles.shape, generator=random).double()
        if self.sensor.off_axis != "ideal":
            angles = self._as_rays_meet_them(angles)
        return analyser_matrix(torch.rad2deg(angles), passed[which], ratio[which]).movedim(-1, -3).contiguous()

    def _as_rays_meet_them(self, angles: Tensor) -> Tensor:
        """Angles (..., H, W) of analysers on the sensor → in each ray's own reference axes."""
        rays = torch.from_numpy(ray_map(self.camera)[0].copy()).reshape(-1, 3)
        axis = lambda *v: torch.tensor(v, dtype=torch.float64).expand_as(rays)
        x, y = reference_axes(rays, axis(1.0, 0.0, 0.0))
        flat = angles.reshape(-1, len(rays)).T
        e = analyser_axes(rays, axis(1.0, 0.0, 0.0), flat, self.sensor.off_axis, axis(0.0, 0.0, 1.0))
        return frame_angle(x[:, None], y[:, None], e).T.reshape(angles.shape)

    def to_pixels(self, light: Tensor, supersampling: int) -> Tensor:
        """Light (..., sH, sW) on a grid ``supersampling`` times finer than the pixels → (..., H, W): the lens' blur and the aperture."""
        return aperture(blur(light, self.sensor.psf_sigma_px * supersampling), supersampling)

    def expose(self, light: Tensor) -> Tensor:
        """Light on the pixels → at their photosites, without noise.

        Args:
            light: (B, C, H, W), or with analysers (B, C, 3, H, W) Stokes vectors about the camera's x axis.
        Returns:
            (B, H, W) behind the mosaic, else (B, C, H, W).
        Raises:
            ValueError: light of another size.
        """
        channels = light.shape[1] if self.mosaic is None else int(self.mosaic.max()) + 1
        expected = (*((3,) if self.analysers else ()), self.camera.height, self.camera.width)
        if light.dim() != 2 + len(expected) or tuple(light.shape[2:]) != expected or light.shape[1] != channels:
            raise ValueError(f"light of shape {tuple(light.shape)}, expected (B, {channels}, {', '.join(map(str, expected))})")
        light = light * (self.sensor.exposure * self.vignetting.to(light))
        if self.mosaic is not None:
            index = self.channel.to(light.device)
            light = light.gather(1, index.expand(len(light), 1, *light.shape[2:]))[:, 0]
        return (light * self.analyser.to(light)).sum(-3) if self.analysers else light

    def forward(self, light: Tensor, frames: Sequence[int], supersampling: int = 1) -> Tensor:
        """Raw frames [DN], whole numbers of light's type, shaped as ``expose`` gives.

        Args:
            light: (B, C, sH, sW) or (B, C, 3, sH, sW), s = ``supersampling``. frames: B ids, which key the noise.
        """
        return self.record(self.expose(self.to_pixels(light, supersampling)), frames)

    def record(self, exposed: Tensor, frames: Sequence[int]) -> Tensor:
        """Noise, gain and rounding of what ``expose`` gives."""
        if exposed.dim() == 3:
            return record(exposed, self.sensor.noise, frames, self.sensor.name, self.seed)
        planes = [record(exposed[:, c], self.sensor.noise, frames, f"{self.sensor.name}/{c}", self.seed) for c in range(exposed.shape[1])]
        return torch.stack(planes, 1)
