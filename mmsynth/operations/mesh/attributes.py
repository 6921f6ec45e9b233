"""Values of every modality at the vertices of a mesh.

A *view* is one place of the rig: of each training view the frame of the first sensor that it has, with that frame's pose and lens. All
modalities are asked along the same rays, so that a vertex has one spectrum and not five from five directions.

A view sees a vertex when the vertex faces it, lies in its image through its lens, and the field's depth there is the vertex's own within
a pixel's footprint on the slanted surface. That is read from depth maps of at most 160 columns. Four to eight of the views that see a
vertex, evenly from the squarest to the most grazing, cast a ray through it: if the ray ends within 1 % of the vertex's distance, its light
counts. Attributes are means over these rays. (On a synthetic room, means over 4 and 8 rays were 8 % and 5 % off those over all
views, rms of rgb; over the 4 squarest views 13 %, and their DoLP was far too low: it grows away from the normal.)

Attributes, float32, NaN where no ray reached the vertex:

* ``<modality>_<i>``: channel i, linear, 1.0 = the sensor's full scale. Of a polarization modality, whose channels depend on how a camera is
  rolled, instead ``<modality>_s0``, the light; ``<modality>_dolp``: degree of linear polarization, Σ p S0 / Σ S0; and
  ``<modality>_axis_x, _y, _z``: the axis along which it swings, a unit vector in world space (its sign has no meaning), the first
  eigenvector of T = Σ p S0 e eᵀ. Angles are never averaged. ``<modality>_axis_share``: λ₁ / tr T, 1 where all rays agree on the axis,
  1/3 where it is anywhere. Each ray's polarization is perpendicular to it, so axes of different views differ a little by necessity.
* where surfaces mirror lamps: ``<modality>_base_<i>`` (``<modality>_base_s0``), the same light without the lamps' images, which stay where
  they are when the viewer moves no more than other paint does; ``roughness``, α of GGX, and ``strength``, the height of a highlight in
  units of the lamp (see ``field.kernels.mirroring``).
* ``views``: how many training views see the vertex. ``spread``: standard deviation of the rays' light (the mean over modalities of
  their mean channel, S0 of polarization) over its mean: large where the surface shines, or is in the wrong place.
* ``confidence`` in [0, 1]: views / (views + 8) · 1 / (1 + spread / 4) · 1 / (1 + residual / 0.1), with the residual |f| / cell at the
  vertex; 0 where no view sees it. It orders vertices and is no probability: in that room, the median distance to the true surface fell with
  it, most of that by the number of views.

``visual.vertex_colors`` is a preview: the first modality whose channels make colours (rgb, else the first of all), tone-mapped, without
the lamps' images where these are known, grey 128 where nothing was seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh

from mmsynth.errors import InputError
from mmsynth.operations.output import previews
from mmsynth.operations.output.progress import Counter, Progress, parts
from mmsynth.operations.views.visibility import inside
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import project, resized
from mmsynth.sensors.polarization import reference_axes, stokes_to_coherency

if TYPE_CHECKING:
    from mmsynth.field.field import Field
    from mmsynth.scene.scene import Scene, Sensor

_RAYS, _RAYS_IN_ALL = (4, 8), 2_500_000  # per vertex; the more, the fewer vertices there are
_COLUMNS = 160  # of a depth map
_GRAZING = 0.15  # cosine to the normal from which a vertex is seen
_AGREES = 0.01  # of the distance
_CHUNK = 1 << 16  # vertices at a time
_UNSEEN = 128


def training_views(field: Field, scene: Scene) -> list[PosedCamera]:
    """Camera and pose (as the fit corrected it) of every training view: of the first sensor that has a frame in it.

    Raises:
        InputError: the scene has none.
    """
    frames: dict[int, PosedCamera] = {}
    for sensor in scene.sensors:
        for frame in scene.frames_of(sensor, scene.split.train):
            frames.setdefault(frame.view, PosedCamera(frame.camera, field.pose_of(frame)))
    if not frames:
        raise InputError(f"{scene.root}: no training views, from which the mesh's attributes are seen.")
    return [frames[view] for view in sorted(frames)]


def coarse(view: PosedCamera) -> PosedCamera:
    """The same view on the grid of a depth map."""
    return replace(view, camera=resized(view.camera, min(_COLUMNS, view.camera.width)))


@dataclass(frozen=True)
class View:
    """A camera at its place and what it sees: depth_ray (H, W), distance along the ray, NaN = nothing; scene unit."""

    posed: PosedCamera
    depth_ray: np.ndarray

    def sees(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Which points the depth map shows: a point may be deeper by a pixel's footprint on its slanted surface, and 1 % of its distance.

        Args:
            points: (N, 3) world. normals: (N, 3) unit, outward; NaN faces nobody.
        Returns:
            (N,) float64: cosine between normal and ray where the point is seen, 0 where not.
        """
        camera, pose = self.posed.camera, self.posed.camera_to_world
        away = points - pose[:3, 3]
        distance = np.linalg.norm(away, axis=1)
        cosine = -np.einsum("ni,ni->n", away, normals) / np.where(distance > 0, distance, 1.0)
        out = np.zeros(len(points))
        rows = np.flatnonzero(cosine > _GRAZING)
        pixels = project(away[rows] @ pose[:3, :3], camera)
        within = inside(pixels, camera)
        rows, pixels = rows[within], np.rint(pixels[within]).astype(np.int64)
        met = self.depth_ray[pixels[:, 1], pixels[:, 0]]
        footprint = distance[rows] / min(camera.fx, camera.fy)
        rows = rows[np.abs(distance[rows] - met) <= footprint / cosine[rows] + _AGREES * distance[rows]]
        out[rows] = cosine[rows]
        return out


def depth_maps(field: Field, scene: Scene, progress: Progress | None = None) -> list[View]:
    """What each training view sees; ``progress``: called with (views done, views in all)."""
    views = training_views(field, scene)
    out = []
    for done, view in enumerate(map(coarse, views), 1):
        out.append(View(view, field.render(view.camera, view.camera_to_world, []).depth_ray))
        if progress is not None:
            progress(done, len(views))
    return out


def views_that_see(views: Sequence[View], points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(views, N) float32: cosine between normal and ray where a view sees a point, 0 where not."""
    return np.stack([view.sees(points, normals) for view in views]).astype(np.float32)


class _Sums:
    """Of the rays of each vertex: light, the lamps' images in it, polarization, and how much it varies."""

    def __init__(self, count: int, sensors: Sequence[Sensor], shines: bool) -> None:
        self.rays = np.zeros(count)
        self.light = {s.name: np.zeros((count, 1 if s.is_polarization else s.channel_count)) for s in sensors}
        self.axes = {s.name: np.zeros((count, 3, 3)) for s in sensors if s.is_polarization}
        self.brightness = np.zeros((count, 2))
        self.mirrored = {name: np.zeros_like(light) for name, light in self.light.items()} if shines else {}
        self.material = np.zeros((count, 2))  # roughness, strength

    def add(self, rows: np.ndarray, cast: dict[str, np.ndarray], directions: np.ndarray, camera_x: np.ndarray) -> None:
        """Rays to vertices ``rows`` (N,), each at most once; directions (N, 3) world."""
        brightness = np.zeros(len(rows))
        for name, sums in self.light.items():
            if name in self.axes:
                s0, s1, s2 = np.moveaxis(cast[f"stokes/{name}"].astype(np.float64), -1, 0)
                sums[rows, 0] += s0
                brightness += s0
                self.axes[name][rows] += polarized_part(s1, s2, directions, camera_x)
            else:
                sums[rows] += cast[name]
                brightness += cast[name].mean(1)
        for name, sums in self.mirrored.items():
            sums[rows] += cast[f"mirrored_s0/{name}"][:, None] if name in self.axes else cast[f"mirrored/{name}"]
        if self.mirrored:
            self.material[rows] += np.stack([cast["roughness"], cast["strength"]], 1)
        brightness /= len(self.light)
        self.rays[rows] += 1.0
        self.brightness[rows] += np.stack([brightness, brightness**2], 1)


def polarized_part(s1: np.ndarray, s2: np.ndarray, directions: np.ndarray, camera_x: np.ndarray) -> np.ndarray:
    """p S0 e eᵀ of light with S1, S2 (N,) about the camera's x axis (3,) along rays (N, 3): (N, 3, 3), world; e: where it swings."""
    x, y = reference_axes(torch.from_numpy(directions), torch.from_numpy(camera_x).expand(len(directions), 3))
    swinging = torch.from_numpy(np.stack([np.hypot(s1, s2), s1, s2], -1))  # light that is polarized through and through
    return stokes_to_coherency(swinging, x, y).numpy()


def add_attributes(mesh: trimesh.Trimesh, field: Field, scene: Scene, cell: float, progress: Progress | None = None) -> None:
    """Fill ``mesh.vertex_attributes``, ``mesh.metadata["properties"]`` (a sentence for each) and the preview colours.

    Args:
        mesh: in the field's frame, with unit normals. cell: length that the residual is measured in (scene unit).
        progress: called with (parts done, parts in all).
    Raises:
        InputError: the scene has no training views.
    """
    shares = parts(progress, (0.1, 0.9))
    views = depth_maps(field, scene, next(shares))
    points, outward = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    sensors = list(field.sensors.values())
    rays = min(max(_RAYS_IN_ALL // max(len(points), 1), _RAYS[0]), _RAYS[1])
    count = Counter(next(shares), len(points))
    found: list[dict[str, np.ndarray]] = []
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        found.append(_of_part(field, sensors, views, points[part], outward[part], cell, rays))
        count(len(points[part]))
    values = {key: np.concatenate([part[key] for part in found]).astype(np.float32) for key in found[0]}
    mesh.vertex_attributes.update(values)
    mesh.metadata["properties"] = _described(sensors, field.shines, field.predicted)
    visual: Any = mesh.visual
    visual.vertex_colors = _preview(sensors, values)


def _of_part(
    field: Field, sensors: Sequence[Sensor], views: Sequence[View], points: np.ndarray, normals: np.ndarray, cell: float, rays: int
) -> dict[str, np.ndarray]:
    cosines = views_that_see(views, points, normals)
    sums = _Sums(len(points), sensors, field.shines)
    asked = _evenly(cosines, rays)
    for i, view in enumerate(views):
        rows = np.flatnonzero(asked[i])
        pose = view.posed.camera_to_world
        away = points[rows] - pose[:3, 3]
        distance = np.linalg.norm(away, axis=1)
        directions = away / distance[:, None]
        cast = field.cast(directions @ pose[:3, :3], pose, [s.name for s in sensors], geometry=False, light=field.shines)
        met = np.abs(cast["depth"] * field.region.radius - distance) <= _AGREES * distance  # NaN (no hit) is not
        sums.add(rows[met], {key: value[met] for key, value in cast.items()}, directions[met], pose[:3, 0])
    return _means(sums, sensors, (cosines > 0).sum(0), np.abs(field.sdf(points)) / cell)


def _evenly(cosines: np.ndarray, most: int) -> np.ndarray:
    """Of the views that see each vertex, at most so many, evenly from the squarest to the most grazing: (views, N) bool.

    Polarization and gloss follow the angle: means over the squarest views alone would be others than those over all.
    """
    order = np.argsort(-cosines, axis=0)
    count = (cosines > 0).sum(0)
    asked = np.zeros(cosines.shape, bool)
    for i in range(min(most, len(cosines))):
        rank = np.where(count > most, ((i + 0.5) * count / most).astype(np.int64), i)
        rows = np.flatnonzero(rank < count)
        asked[order[rank[rows], rows], rows] = True
    return asked


def _means(sums: _Sums, sensors: Sequence[Sensor], views: np.ndarray, residual: np.ndarray) -> dict[str, np.ndarray]:
    reached = sums.rays > 0
    rays = np.where(reached, sums.rays, np.nan)
    out: dict[str, np.ndarray] = {}
    for sensor in sensors:
        light = sums.light[sensor.name]
        if sensor.name in sums.mirrored:
            base = light - sums.mirrored[sensor.name]
            keys = ["s0"] if sensor.is_polarization else range(sensor.channel_count)
            out |= {f"{sensor.name}_base_{key}": base[:, i] / rays for i, key in enumerate(keys)}
        if not sensor.is_polarization:
            out |= {f"{sensor.name}_{i}": light[:, i] / rays for i in range(sensor.channel_count)}
            continue
        strengths, vectors = np.linalg.eigh(sums.axes[sensor.name])
        total = strengths.sum(1)
        swings = reached & (total > 0)
        axis = np.where(swings[:, None], vectors[:, :, -1], np.nan)
        out[f"{sensor.name}_s0"] = light[:, 0] / rays
        out[f"{sensor.name}_dolp"] = np.divide(total, light[:, 0], out=np.full(len(rays), np.nan), where=reached & (light[:, 0] > 0))
        out |= {f"{sensor.name}_axis_{c}": axis[:, i] for i, c in enumerate("xyz")}
        out[f"{sensor.name}_axis_share"] = np.divide(strengths[:, -1], total, out=np.full(len(rays), np.nan), where=swings)
    if sums.mirrored:
        out["roughness"], out["strength"] = (sums.material / rays[:, None]).T
    mean, square = (sums.brightness / rays[:, None]).T
    # the difference of two nearly equal numbers may round to less than nothing
    variance = np.maximum(square - mean**2, 0.0)
    spread = np.divide(np.sqrt(variance), mean, out=np.full(len(rays), np.nan), where=(sums.rays > 1) & (mean > 0))
    steady = np.where(np.isfinite(spread), 1.0 / (1.0 + spread / 4.0), 1.0)
    out["views"], out["spread"] = views, spread
    out["confidence"] = np.where(reached, views / (views + 8.0) * steady / (1.0 + residual / 0.1), 0.0)
    return out


def _described(sensors: Sequence[Sensor], shines: bool, predicted: Sequence[str]) -> dict[str, str]:
    """Property → what it is: channel and wavelength, and whether a prior predicted it."""
    out: dict[str, str] = {}
    for sensor in sensors:
        if sensor.is_polarization:
            if shines:
                out[f"{sensor.name}_base_s0"] = "S0 without the images of lamps, linear, 1 = full scale"
            out[f"{sensor.name}_s0"] = "S0, linear, 1 = full scale"
            out[f"{sensor.name}_dolp"] = "degree of linear polarization"
            out |= {f"{sensor.name}_axis_{c}": f"axis of polarization, {c}, world frame, sign free" for c in "xyz"}
            out[f"{sensor.name}_axis_share"] = "agreement of the views on the axis, 1/3 to 1"
            continue
        for i, (label, wave) in enumerate(zip(sensor.channels, sensor.wavelengths_nm, strict=True)):
            at = "" if wave is None else f", wavelength_nm {wave:g}"
            out[f"{sensor.name}_{i}"] = f"channel {label}{at}, linear, 1 = full scale"
            if shines:
                out[f"{sensor.name}_base_{i}"] = f"channel {label}{at}, without the images of lamps, linear, 1 = full scale"
    for name in predicted:
        out |= {key: f"{said}, predicted by a prior" for key, said in out.items() if key.startswith(f"{name}_")}
    if shines:
        out |= {"roughness": "roughness of the mirror, alpha of GGX, 0 to 1", "strength": "height of a highlight in units of the lamp"}
    return out | {
        "views": "training views that see the vertex",
        "spread": "deviation of the light between rays over its mean",
        "confidence": "confidence, 0 to 1, from views, spread and residual",
    }


def _preview(sensors: Sequence[Sensor], values: dict[str, np.ndarray]) -> np.ndarray:
    """(V, 4) uint8."""
    plain = [s for s in sensors if not s.is_polarization]
    chosen = next((s for s in plain if s.channel_count > 1), plain[0] if plain else None)
    if chosen is not None:
        base = f"{chosen.name}_base" if f"{chosen.name}_base_0" in values else chosen.name
        channels = np.stack([values[f"{base}_{i}"] for i in range(chosen.channel_count)], -1)
        linear = previews.preview_linear(chosen, channels)
    else:
        linear = np.repeat(values[f"{sensors[0].name}_s0"][:, None], 3, 1)
    seen = np.isfinite(values["confidence"]) & (values["confidence"] > 0)
    out = np.full((len(linear), 4), _UNSEEN, np.uint8)
    out[:, 3] = 255
    if seen.any():
        out[seen, :3] = previews.to_uint8(previews.tone_map(linear[seen]))
    return out
