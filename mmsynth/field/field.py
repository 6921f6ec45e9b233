"""The field of a scene: learned by a fit, rendered by every operation.

Its parts, and what rays see of them together, stand in one file: what one of them is decides what the others show.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mmsynth.errors import InputError
from mmsynth.field import kernels, rendering
from mmsynth.field.design import Corrections, Design
from mmsynth.field.encoding import HashGrid
from mmsynth.field.kernels import Sampling
from mmsynth.field.kernels.learning import normals, with_far_light
from mmsynth.field.kernels.mirroring import material
from mmsynth.field.light import Light, mean_spectrum, stokes, stokes_around
from mmsynth.field.occupancy import Occupancy
from mmsynth.field.picture import Rendering, picture_of
from mmsynth.field.radiance import Shader
from mmsynth.field.surface import Surface
from mmsynth.parallel import tile_by_tile
from mmsynth.prior.prediction import Prediction, Seen
from mmsynth.prior.samples import shapes_of
from mmsynth.scene.scene import Frame, Region, Sensor
from mmsynth.sensors.camera import Camera, rays_of_pixels
from mmsynth.sensors.polarization import reference_axes, stokes_to_intensities

TILE, _ON_GPU = 8192, 1 << 17  # rays at a time: what they need stays in the caches; of a GPU fewer leave most idle
MIRROR_CELLS = 2.0  # over which normals of mirrors are differences: one has the grid's noise in it, three blur the edges
_WITHIN = 1.0 + 1e-4  # of the region's radius, with room for rounding


class Field(nn.Module):
    """One radiance field of a scene.

    The parts work in a normalised frame in which ``region`` is the unit ball; every public method takes and gives the
    scene's world frame and unit.

    Attributes:
        sensors: the modalities it knows, those that a prior predicts after those that were measured. cameras: representative intrinsics of
            each that was measured.
        prediction: of modalities that were not measured, None: there are none.
        rig: sensor → (4, 4) sensor_to_reference, scene unit; the reference is the first sensor.
        sampling: how finely it is rendered. manifest: everything known about the fit.
        view_dependence: degree of the spherical harmonics of each modality's radiance.
        light: lamps, and what surfaces mirror of them; None where nothing shines.
        far_light: (F,) features of the light that passes the region, None where that is black or the background is modelled.
        corrections: of the poses of the scene's frames (see ``pose_of``); the rig has them already.
    """

    def __init__(
        self,
        design: Design,
        sensors: dict[str, Sensor],
        radiance_scale: dict[str, float],
        region: Region,
        unit: str = "input unit",
        cameras: dict[str, Camera] | None = None,
        rig: dict[str, np.ndarray] | None = None,
    ) -> None:
        super().__init__()
        d = self.design = design
        self.sensors, self.radiance_scale, self.region, self.unit = sensors, radiance_scale, region, unit
        self.cameras, self.rig = cameras or {}, rig or {}
        self.view_dependence = dict.fromkeys(sensors, 0)
        self.corrections = Corrections({}, {})
        self.prediction: Prediction | None = None
        self.manifest: dict[str, Any] = {}
        extent = 2.0 if d.background else 1.0
        spheres = (d.initial_radius, d.outer_radius if d.background else 1e9)
        self.surface = Surface(
            HashGrid(d.surface_levels, d.surface_rows_log2, d.coarsest, d.surface_finest, extent), d.surface_hidden, spheres
        )
        self.appearance = HashGrid(d.radiance_levels, d.radiance_rows_log2, d.coarsest, d.radiance_finest, extent)
        self.shader = Shader(self.appearance.width, d.radiance_hidden, sensors, radiance_scale)
        self.light = Light(self.appearance.width, self.shader.heads.out_features) if d.light else None
        self.far_light = nn.Parameter(torch.zeros(self.appearance.width)) if d.far_light else None
        self.occupancy = Occupancy(d.occupancy, extent)
        self.sampling = Sampling(20.0, 0.05, d.surface_levels, d.radiance_levels)

    @property
    def device(self) -> torch.device:
        return self.occupancy.states.device

    @property
    def measured(self) -> list[str]:
        """The modalities that were learned from frames."""
        return list(self.radiance_scale)

    def predict(self, prediction: Prediction) -> None:
        """Know the modalities of a prior, too."""
        self.prediction = prediction
        self.sensors = {name: self.sensors[name] for name in self.measured} | prediction.sensors

    def pose_of(self, frame: Frame) -> np.ndarray:
        """(4, 4) camera_to_world of a frame of the scene, corrected by what the fit found.

        A view that was not learned from has no correction of its own: its frames get that of their sensor alone.
        """
        pose = frame.camera_to_world @ self.corrections.sensors.get(frame.sensor, np.eye(4))
        return self.corrections.views.get(frame.view, np.eye(4)) @ pose

    def resize_tables(
        self, surface: tuple[int, ...], radiance: tuple[int, ...], first: tuple[int, int], generator: torch.Generator
    ) -> dict[str, int]:
        """Other numbers of rows for the finer levels of the hash tables, which start anew.

        Args:
            surface, radiance: log2 of the most rows of each level. first: levels of the two that are the first to be resized.
        Returns:
            by parameter, how many of its first rows are as they were.
        """
        self.design = replace(self.design, surface_rows_log2=surface, radiance_rows_log2=radiance)
        return {
            "surface.grid.table": self.surface.grid.resize(first[0], surface, generator),
            "appearance.table": self.appearance.resize(first[1], radiance, generator),
        }

    def rows_met(self, sampling: Sampling) -> dict[str, int]:
        """How many of the first rows of each hash table are of levels in use."""
        surface, radiance = self.surface.grid.offsets[sampling.active_surface], self.appearance.offsets[sampling.active_radiance]
        return {"surface.grid.table": int(surface), "appearance.table": int(radiance)}

    def to_normalised(self, points: np.ndarray) -> Tensor:
        """World points (..., 3) → normalised frame, float32 on the field's device."""
        unit = (np.asarray(points, dtype=np.float64) - np.array(self.region.centre)) / self.region.radius
        return torch.from_numpy(unit.astype(np.float32)).to(self.device)

    def with_far_light(self, hits: rendering.Hits) -> rendering.Hits:
        """What is shaded, see ``learning.with_far_light``."""
        return hits if self.far_light is None else with_far_light(hits, self.far_light)

    def slopes(self, points: Tensor, active: int, cells: float = 1.0) -> Tensor:
        """∇sdf (N, 3) in the frame of the grid, at points (N, 3) of the normalised frame, by differences over so many cells."""
        return self.surface.gradient(self.surface.grid.to_grid(points), cells * self.surface.grid.cell(active), active)

    def normals(self, points: Tensor, slopes: Tensor) -> Tensor:
        """Unit, outward (N, 3), in the normalised frame, from ``slopes`` at these points."""
        return normals(points, slopes, self.surface.grid.extent)

    @torch.no_grad()
    def sdf(self, points: np.ndarray) -> np.ndarray:
        """Signed distance in the scene's unit, positive outside: (N, 3) → (N,) float32. Of contracted space, where it is."""
        parts = self.to_normalised(points).split(65536)
        values = [self.surface(self.surface.grid.to_grid(part), self.sampling.active_surface) for part in parts]
        return torch.cat(values).cpu().numpy() * np.float32(self.region.radius) if values else np.empty(0, np.float32)

    def trace(self, origins: Tensor, directions: Tensor, sampling: Sampling) -> rendering.Hits:
        """What rays of the normalised frame meet, (R, 3) each, with samples in the middle of their steps: see ``rendering.trace``."""
        middle = torch.full((len(origins),), 0.5, device=origins.device)
        return rendering.trace(self.surface, self.appearance, self.occupancy, origins, directions, middle, sampling)

    @torch.no_grad()
    def render_rays(
        self, origins: Tensor, directions: Tensor, camera_x: Tensor, modalities: Sequence[str], geometry: bool, light: bool = False
    ) -> dict[str, Tensor]:
        """Rays of the normalised frame, R of them → per modality (R, C), ``stokes/<name>`` (R, 3), opacity, depth.

        With ``geometry`` also normal: that takes four more samples a ray, depth comes with the light. With ``light``, of a field whose
        surfaces mirror lamps, also ``mirrored/<name>`` (R, C), the images of lamps in each modality, and roughness and strength (R,): means
        over the surfaces met, NaN where less than half of a ray meets any; of a polarization modality ``mirrored_s0/<name>`` (R,), too; and
        ``images`` (R, 3), Stokes vectors of lamps of their mean spectrum. Of a predicted modality also ``deviation/<name>`` (R, C).
        """
        hits = self.trace(origins, directions, self.sampling)
        return self.shade_hits(hits, origins, directions, camera_x, modalities, geometry, light)

    @torch.no_grad()
    def shade_hits(
        self,
        hits: rendering.Hits,
        origins: Tensor,
        directions: Tensor,
        camera_x: Tensor,
        modalities: Sequence[str],
        geometry: bool,
        light: bool = False,
    ) -> dict[str, Tensor]:
        """What rays show that met ``hits``: see ``render_rays``."""
        wanted, measured = ([n for n in modalities if (n in self.predicted) == predicted] for predicted in (True, False))
        if (prediction := self.prediction) is None or not wanted:
            return self._shade(hits, origins, directions, camera_x, measured, geometry, light)
        polarized = any(self.sensors[name].is_polarization for name in wanted)
        needed = list(dict.fromkeys([*measured, *prediction.facts.known]))
        out = self._shade(hits, origins, directions, camera_x, needed, geometry or polarized, True)
        found = prediction(self.seen(out, origins, directions, camera_x, polarized))
        for name in wanted:
            out[name], out[f"deviation/{name}"], out[f"mirrored/{name}"] = found[name].light, found[name].deviation, found[name].images
            stokes, of_lamps = found[name].stokes, found[name].images_s0
            if stokes is not None and of_lamps is not None:
                out[f"stokes/{name}"], out[f"mirrored_s0/{name}"] = stokes, of_lamps
        return out

    @property
    def predicted(self) -> list[str]:
        """The modalities that a prior predicts."""
        return [] if self.prediction is None else list(self.prediction.sensors)

    @property
    def corrected(self) -> list[str]:
        """The predicted modalities of which the scene has frames."""
        return [] if self.prediction is None else list(self.prediction.corrections)

    def seen(self, out: dict[str, Tensor], origins: Tensor, directions: Tensor, camera_x: Tensor, polarized: bool) -> Seen:
        """What rays show that a prior predicts from, of what ``render_rays`` found with ``light`` and, if ``polarized``, geometry."""
        zero = torch.zeros_like(out["opacity"])
        shapes = None
        if polarized:
            met = torch.isfinite(out["normal"]).all(1)
            x, y = reference_axes(directions, camera_x)
            gloss = [torch.where(met & torch.isfinite(out.get(key, zero)), out.get(key, zero), zero) for key in ("roughness", "strength")]
            shapes = shapes_of(torch.where(met[:, None], out["normal"], -directions), directions, x, y, *gloss)
        far = torch.where(torch.isfinite(out["depth"]), out["depth"], torch.full_like(zero, rendering.FARTHEST))
        body = {name: self.body_of(name, out) for name in self.measured if name in out}
        return Seen(body, out.get("images", torch.zeros_like(directions)), shapes, origins + directions * far[:, None])

    def body_of(self, name: str, seen: dict[str, Tensor]) -> Tensor:
        """Light without the images of lamps (R, C), of polarization S0 (R, 1), of what ``render_rays`` found with ``light``."""
        if self.sensors[name].is_polarization:
            s0 = seen[f"stokes/{name}"][:, :1]
            return s0 - seen[f"mirrored_s0/{name}"][:, None] if self.shines else s0
        return seen[name] - seen[f"mirrored/{name}"] if self.shines else seen[name]

    def _shade(
        self,
        hits: rendering.Hits,
        origins: Tensor,
        directions: Tensor,
        camera_x: Tensor,
        modalities: Sequence[str],
        geometry: bool,
        light: bool = False,
    ) -> dict[str, Tensor]:
        """``shade_hits`` of measured modalities."""
        shaded, rays = self.with_far_light(hits), len(directions)
        ray = kernels.rays_of(hits.behind, len(hits.share))
        lamps = self.light.lamps() if self.light is not None and self.shines and modalities else None
        mirrors = None if lamps is None else self.mirrors(hits, origins, directions, self.sampling.active_surface)[0]
        images = None if lamps is None or mirrors is None else kernels.reflect(lamps.position, mirrors)
        polarized = any(self.sensors[n].is_polarization for n in modalities)
        around = kernels.surround(mirrors) if mirrors is not None and polarized else None  # others do not see how light swings
        lit = hits.share if mirrors is None else mirrors.share  # of what has a place
        outputs = {d: self.shader(shaded.features, directions[ray], d) for d in {self.view_dependence[n] for n in modalities}}

        def together(values: Tensor, share: Tensor) -> Tensor:
            """Of the surfaces that a ray meets, (H, C) → (R, C)."""
            seen = share[:, None] * values
            return seen[:rays].index_add(0, ray[rays:], seen[rays:])

        # a background is opaque, too, but what lies there is not the object
        reached = torch.linalg.vector_norm(origins + directions * hits.depth[:, None], dim=-1)
        within = torch.isnan(hits.depth) | (reached <= _WITHIN)
        seen = torch.where(within, hits.opacity, torch.zeros_like(hits.opacity)).clamp(0.0, 1.0)
        out = {"opacity": seen, "depth": hits.depth}
        for name in modalities:
            raw, scale = outputs[self.view_dependence[name]], self.radiance_scale[name]
            angles = self.sensors[name].polarizer_angles_deg
            if angles is None:
                out[name] = together(self.shader.values(name, raw), shaded.share)
                if lamps is not None and images is not None:
                    mirrored = scale * together(images.amount @ lamps.spectrum[:, self.shader.columns[name]], lit)
                    out[name] += mirrored
                    if light:
                        out[f"mirrored/{name}"] = mirrored
                continue
            x, y = (axis[ray] for axis in reference_axes(directions, camera_x))
            behind, vectors = self.shader.polarized(name, raw, x, y, torch.deg2rad(torch.tensor(angles, device=origins.device)))
            out[name], out[f"stokes/{name}"] = together(behind, shaded.share), together(vectors, shaded.share)
            if lamps is not None and images is not None and around is not None:
                of_lamps = scale * together(stokes(images, lamps.spectrum[:, self.shader.columns[name].start], x, y), lit)
                more = of_lamps + scale * together(stokes_around(around, x, y), lit)
                out[f"stokes/{name}"] += more
                out[name] += stokes_to_intensities(more, angles)
                if light:
                    out[f"mirrored/{name}"], out[f"mirrored_s0/{name}"] = stokes_to_intensities(of_lamps, angles), of_lamps[:, 0]
        if light and mirrors is not None:
            if lamps is not None and images is not None:
                x, y = (axis[ray] for axis in reference_axes(directions, camera_x))
                out["images"] = together(stokes(images, (lamps.spectrum / mean_spectrum(lamps.spectrum)).mean(1), x, y), lit)
            of = material(mirrors.material)
            met = torch.where(hits.opacity > 0.5, hits.opacity, torch.full_like(hits.opacity, float("nan")))
            for key, value in (("roughness", of.roughness), ("strength", of.strength)):
                out[key] = together(value[:, None], hits.share)[:, 0] / met
        if geometry:
            # of the surface at which half of the light is met
            nearest = torch.where((hits.share[:rays] >= 0.5) | (hits.behind < 0), ray[:rays], hits.behind)
            hit = torch.nonzero(torch.isfinite(hits.depth))[:, 0]
            normal = torch.full_like(directions, float("nan"))
            if mirrors is None:
                points = origins[hit] + directions[hit] * hits.depth[hit, None]
                normal[hit] = self.normals(points, self.slopes(points, self.sampling.active_surface))
            else:
                normal[hit] = mirrors.normals[nearest[hit]]
            out["normal"] = normal
        return out

    @property
    def tile(self) -> int:
        """How many rays to cast at a time."""
        return TILE if self.device.type == "cpu" else _ON_GPU

    @property
    def shines(self) -> bool:
        """Whether there are lamps whose light surfaces mirror."""
        return self.light is not None and self.light.count > 0

    def mirrors(self, hits: rendering.Hits, origins: Tensor, directions: Tensor, active: int) -> tuple[kernels.Mirrors, Tensor]:
        """The surfaces that rays met as mirrors of the field's lamps, and ∇sdf there in the frame of the grid, (H, 3).

        Args:
            active: levels of the surface's grid.
        Raises:
            ValueError: the field has no light.
        """
        if self.light is None:
            raise ValueError("a field without light")
        ray = kernels.rays_of(hits.behind, len(hits.share))
        points = origins[ray] + directions[ray] * hits.distance[:, None]
        slopes = self.slopes(points.detach(), active, MIRROR_CELLS)
        share = torch.where(hits.distance > 0, hits.share, torch.zeros_like(hits.share))  # without a place there is no normal
        outward = self.normals(points.detach(), slopes)
        return kernels.Mirrors(self.light.material(hits.features), outward, points, directions[ray], share), slopes

    def mirrored(self, hits: rendering.Hits, origins: Tensor, directions: Tensor, measured: kernels.Measured, active: int) -> Tensor:
        """Mirrored light in each number that was measured along rays, (M,), 0 where nothing shines."""
        if self.light is None or not self.shines:
            return torch.zeros_like(measured.level)
        mirrors, _ = self.mirrors(hits, origins, directions, active)
        return kernels.mirror(self.light.lamps(), mirrors, hits.behind, measured) * measured.level

    def cast(
        self, directions: np.ndarray, camera_to_world: np.ndarray, modalities: Sequence[str], geometry: bool, light: bool = False
    ) -> dict[str, np.ndarray]:
        """``render_rays`` of rays of one camera: directions (R, 3) in its axes, scene frame; depth stays in radii."""
        found = self.render_rays(*self.rays_of(directions, camera_to_world), modalities, geometry, light)
        return {key: value.cpu().numpy() for key, value in found.items()}

    def cast_tiles(
        self,
        parts: Iterable[tuple[np.ndarray, np.ndarray]],
        camera_to_world: np.ndarray,
        modalities: Sequence[str],
        geometry: bool,
        light: bool = False,
    ) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """``cast`` of as many rays as there are, by tiles, on a CPU side by side.

        Args:
            parts: numbers (N,) of rays and their directions (N, 3), made as they are needed.
        Yields:
            numbers of the rays of a tile, and what they show; tiles in the order of the rays.
        """
        size = self.tile
        tiles = ((index[i : i + size], rays[i : i + size]) for index, rays in parts for i in range(0, len(index), size))
        cast = lambda tile: self.cast(tile[1], camera_to_world, modalities, geometry, light)
        for (index, _), seen in tile_by_tile(self.device, cast, tiles):
            yield index, seen

    def rays_of(self, directions: np.ndarray | Tensor, camera_to_world: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Rays of one camera, (R, 3) in its axes → origins, directions and camera_x of ``render_rays``, (R, 3) each."""
        to_world = torch.as_tensor(camera_to_world[:3, :3].T.astype(np.float64), device=self.device)
        turned = (torch.as_tensor(directions, dtype=torch.float64, device=self.device) @ to_world).float()
        origin = self.to_normalised(camera_to_world[:3, 3]).expand(len(turned), 3)
        return origin, turned, torch.from_numpy(camera_to_world[:3, 0].astype(np.float32)).to(self.device).expand(len(turned), 3)

    def render(
        self,
        camera: Camera,
        camera_to_world: np.ndarray,
        modalities: Sequence[str] | None = None,
        geometry: bool = True,
        progress: Callable[[int], None] | None = None,
    ) -> Rendering:
        """Render a camera.

        Args:
            camera: intrinsics and lens; rays go through the distorted lens.
            camera_to_world: (4, 4), OpenCV axes, scene unit. modalities: names, all when None. geometry: whether normals are wanted; depth
                and opacity cost nothing.
            progress: called with the number of rays done since the last call.
        Raises:
            InputError: an unknown modality, or a pose that is not finite.
        """
        names = self.check_modalities(modalities)
        pose = np.asarray(camera_to_world, dtype=np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise InputError(f"pose: expected a finite 4x4 camera_to_world matrix, found shape {pose.shape} or NaN in it.")
        pixels = camera.width * camera.height
        images: dict[str, np.ndarray] = {}
        valid, forward = np.zeros(pixels, bool), np.zeros(pixels, np.float32)

        def seen(begin: int) -> tuple[np.ndarray, Tensor, dict[str, Tensor]]:
            """Of the pixels of a tile: which have a ray, how far each ray goes ahead, what it shows."""
            there, in_camera = rays_of_pixels(camera, begin, min(begin + self.tile, pixels), self.device)
            found = self.render_rays(*self.rays_of(in_camera, pose), names, geometry) if len(in_camera) else {}
            return there.cpu().numpy(), in_camera[:, 2], found

        for begin, (there, ahead, found) in tile_by_tile(self.device, seen, range(0, pixels, self.tile)):
            rows = slice(begin, begin + len(there))
            valid[rows] = there
            _put(forward[rows], there, ahead)
            for key, value in found.items():
                if key not in images:
                    images[key] = np.full((pixels, *value.shape[1:]), 0.0 if key == "opacity" else np.nan, np.float32)
                _put(images[key][rows], there, value)
            if progress is not None:
                progress(len(ahead))
        picture = functools.partial(picture_of, images, (camera.height, camera.width))
        depth = picture("depth", 1)[..., 0] * np.float32(self.region.radius)
        return Rendering(
            channels={n: picture(n, self.sensors[n].channel_count) for n in names},
            stokes={n: picture(f"stokes/{n}", 3) for n in names if self.sensors[n].is_polarization},
            depth_z=depth * forward.reshape(depth.shape),
            depth_ray=depth,
            normal=picture("normal", 3),
            opacity=picture("opacity", 1, 0.0)[..., 0],
            valid=valid.reshape(depth.shape),
            deviation={n: picture(f"deviation/{n}", self.sensors[n].channel_count) for n in names if n in self.predicted},
        )

    def check_modalities(self, modalities: Sequence[str] | None) -> list[str]:
        """The given names, or all of them.

        Raises:
            InputError: one is unknown to this field.
        """
        names = list(self.sensors) if modalities is None else list(modalities)
        for name in names:
            if name not in self.sensors:
                raise InputError(f"modality {name!r}: not in this field, expected one of {', '.join(self.sensors)}.")
        return names


def _put(pixels: np.ndarray, there: np.ndarray, values: Tensor) -> None:
    """The values of those pixels of a tile that are ``there``: mostly all, and then at once."""
    pixels[... if there.all() else there] = values.cpu().numpy()
