"""Renders the example scene: seven small things on a painted table, seen by five sensors on a rig.

    python examples/render_example_scene.py [--out examples/example_scene] [--spp 196] [--gt-spp 400]

Needs Mitsuba 3 (`pip install mmsynth[example]`) and LLVM 16 or newer (or `--variant cuda_ad_spectral_polarized`). About
eight minutes on one core. Everything is generated here: meshes from formulas, spectra from Gaussians and sigmoids, no files.

What is in it and why: a white and cobalt vase, a rubber duck, a brass pawn (metal), a coral trefoil knot and a printed
cube, glossy (a polarizing coat over a diffuse body, see `pplastic`), on a matte table. Two teal spheres have the same
RGB colour and different spectra: the multispectral and infrared sensors tell them apart. The cube's ink vanishes in the
infrared. Light beyond the objects is black, so the whole scene lies in the region of interest.

How: one ray per sample from the photosite through the lens (own camera model, box filter over the pixel, directions
bilinear between pixel corners: 1e-3 px), four wavelengths per ray drawn from the photosite's own response. All lamps share
one spectrum, which is folded into the responses. Mitsuba returns the Mueller matrix of the path; its first column,
turned to the axes of `mmsynth.sensors.polarization`, is the Stokes vector. Units: metres, nanometres, 1.0 = full scale.
"""

from __future__ import annotations

import argparse
import glob
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh
from skimage.measure import marching_cubes

from mmsynth.sensors.camera import Camera, ray_map, unproject
from mmsynth.sensors.mosaic import channel_map
from mmsynth.sensors.polarization import stokes_to_intensities

WAVELENGTHS = np.arange(400.0, 901.0, 5.0)  # nm
WORLD_SCALE = 0.27  # gt [m] = WORLD_SCALE * world + WORLD_OFFSET
WORLD_OFFSET = np.array([0.0, 0.0, 0.105])
VIEWS = 24
TEST_VIEWS = (9, 19)
FULL_WELL = 10000.0  # electrons at full scale
READ_NOISE = 5.0  # electrons
EXPOSURE_TARGET = 0.8  # of full scale, at the 99.5 percentile of a modality
CLAMP = 3.0  # of full scale, per path sample and wavelength (fireflies)
PATH_DEPTH = 5
TABLE_BINS = 1024  # entries of the inverse cumulative response
POLARIZER_DEG = (0.0, 45.0, 90.0, 135.0)
LABELS = ("background", "table", "vase", "duck", "sphere_a", "sphere_b", "pawn", "knot", "cube")


# --------------------------------------------------------------------------------------------------------- spectra


def bump(centre: float, sigma: float, nm: np.ndarray = WAVELENGTHS) -> np.ndarray:
    """Gaussian of height 1."""
    return np.exp(-0.5 * ((nm - centre) / sigma) ** 2)


def step(centre: float, width: float, nm: np.ndarray = WAVELENGTHS) -> np.ndarray:
    """Sigmoid from 0 to 1."""
    return 1.0 / (1.0 + np.exp(-(nm - centre) / width))


def lamp() -> np.ndarray:
    """Radiance of every lamp (relative): a white LED and a halogen's infrared."""
    return 0.25 + 0.6 * bump(455, 18) + bump(570, 70) + 0.8 * step(640, 60)


def responses() -> dict[str, np.ndarray]:
    """Effective responses (C, wavelengths): quantum efficiency × filter × lamp, each scaled to sum 1.

    So a white matte surface reads the same in all channels of a sensor, and a channel's value is the response-weighted
    mean of a reflectance.
    """
    silicon = step(410, 15) * (1 - step(840, 35))
    cut = 1 - step(690, 6)
    bands = [bump(centre, 13) for centre in (692, 653, 611, 572, 541, 503, 464, 431)]
    curves = {
        "rgb": [bump(605, 32) * cut, bump(540, 38) * cut, bump(462, 28) * cut],
        "infrared": [step(735, 10) * silicon],
        "mono": [silicon * cut],
        "polarization": [silicon * cut],
        "multispectral": [*bands, silicon],
    }
    out = {}
    for name, curve in curves.items():
        table = np.stack(curve) * lamp()
        out[name] = table / table.sum(axis=1, keepdims=True)
    return out


def reflectances() -> dict[str, np.ndarray]:
    """Reflectance spectra in [0, 1] by paint."""
    teal = 0.05 + 0.5 * bump(505, 45)
    paints = {
        "cream": 0.25 + 0.45 * step(480, 35),
        "indigo": 0.05 + 0.22 * bump(450, 40) + 0.6 * step(745, 18),
        "terracotta": 0.06 + 0.45 * step(590, 18) - 0.33 * step(735, 14),
        "glaze": 0.82 * step(395, 12),
        "cobalt": 0.03 + 0.5 * bump(452, 32) + 0.55 * step(705, 14),
        "yellow": 0.05 + 0.77 * step(508, 11),
        "orange": 0.04 + 0.72 * step(584, 11),
        "black": np.full_like(WAVELENGTHS, 0.03),
        "coral": 0.04 + 0.72 * step(596, 9) - 0.5 * step(750, 14),
        "paper": np.full_like(WAVELENGTHS, 0.78),
        "ink": 0.08 + 0.3 * bump(430, 30) + 0.25 * bump(660, 30) + 0.68 * step(735, 10),
        "teal_a": teal,
    }
    # teal_b: three narrow peaks with the same RGB values, and bright in the infrared
    rgb = responses()["rgb"]
    floor = 0.04 + 0.7 * step(760, 14)
    peaks = np.stack([bump(462, 12), bump(515, 12), bump(572, 10)])
    heights = np.linalg.solve(rgb @ peaks.T, rgb @ (teal - floor))
    paints["teal_b"] = floor + heights @ peaks
    for name, value in paints.items():
        if value.min() < 0 or value.max() > 1:
            raise ValueError(f"paint {name}: reflectance {value.min():.3f} .. {value.max():.3f}, expected 0 .. 1")
    return paints


def spectrum(values: np.ndarray, nm: np.ndarray = WAVELENGTHS) -> dict[str, Any]:
    """Mitsuba spectrum of values at evenly spaced wavelengths."""
    text = ", ".join(f"{value:.5f}" for value in values)
    return {"type": "regular", "wavelength_min": nm[0], "wavelength_max": nm[-1], "values": text}


# ---------------------------------------------------------------------------------------------------------- meshes


@dataclass(frozen=True)
class Surface:
    """Triangles with smooth normals: vertices (V, 3) [m], normals (V, 3), uv (V, 2), faces (F, 3)."""

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray

    def moved(self, to: tuple[float, float, float], turn_deg: float = 0.0) -> Surface:
        """Turned about z, then translated [m]."""
        c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return Surface(self.vertices @ rotation.T + np.array(to), self.normals @ rotation.T, self.uv, self.faces)


def grid_surface(vertices: np.ndarray, normals: np.ndarray, uv: np.ndarray) -> Surface:
    """(A, B, ...) lattice → triangles, oriented along the normals."""
    a, b = vertices.shape[:2]
    index = np.arange(a * b).reshape(a, b)
    corner, right, down, across = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack([corner, right, across], -1).reshape(-1, 3), np.stack([corner, across, down], -1).reshape(-1, 3)])
    points, outward = vertices.reshape(-1, 3), normals.reshape(-1, 3)
    edges = points[faces]
    facing = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    area = np.linalg.norm(facing, axis=-1)
    if (facing * outward[faces].mean(1)).sum() < 0:
        faces = faces[:, ::-1]
    return Surface(points, outward, uv.reshape(-1, 2), np.ascontiguousarray(faces[area > 1e-12]))


def smooth_profile(knots: list[tuple[float, float]], count: int) -> np.ndarray:
    """(count, 2) radius and height [m] on a Catmull-Rom curve through the knots."""
    p = np.array([knots[0], *knots, knots[-1]])
    t = np.linspace(0, len(knots) - 1 - 1e-9, count)
    i, f = t.astype(int), (t % 1.0)[:, None]
    p0, p1, p2, p3 = p[i], p[i + 1], p[i + 2], p[i + 3]
    out = 0.5 * (2 * p1 + (p2 - p0) * f + (2 * p0 - 5 * p1 + 4 * p2 - p3) * f**2 + (3 * p1 - p0 - 3 * p2 + p3) * f**3)
    return np.maximum(out, [0.0, -1.0])


def revolve(profile: np.ndarray, segments: int = 48) -> Surface:
    """Surface of revolution about z; the profile (N, 2) runs with the outside on its right (upwards on the outside)."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    radius, height = profile[:, :1], profile[:, 1:]
    slope = np.gradient(profile, axis=0)
    normal = np.stack([slope[:, 1], -slope[:, 0]], -1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    cos, sin = np.cos(angle)[None], np.sin(angle)[None]
    vertices = np.stack([radius * cos, radius * sin, height + 0 * cos], -1)
    normals = np.stack([normal[:, :1] * cos, normal[:, :1] * sin, normal[:, 1:] + 0 * cos], -1)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=-1))])
    u, v = np.broadcast_arrays(angle[None] / (2 * np.pi), (length / length[-1])[:, None])
    return grid_surface(vertices, normals, np.stack([u, v], -1))


def ball(radius: float, segments: int = 32) -> Surface:
    angle = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    return revolve(radius * np.stack([np.cos(angle), np.sin(angle)], -1), segments)


def table_top(radius: float, thickness: float) -> Surface:
    """Disc with a rounded edge, top at z = 0; uv is the plan view."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 9)
    edge = np.stack([radius + thickness / 2 * (np.cos(angle) - 1), thickness / 2 * (np.sin(angle) - 1)], -1)
    rim = radius - thickness / 2
    profile = np.concatenate([[[0, -thickness], [rim - 0.002, -thickness]], edge, [[rim - 0.002, 0], [rim / 2, 0], [0, 0]]])
    surface = revolve(profile, 80)
    return Surface(surface.vertices, surface.normals, surface.vertices[:, :2] / (2 * radius) + 0.5, surface.faces)


def vase() -> Surface:
    outside = [(0.0, 0.0), (0.03, 0.0), (0.036, 0.006), (0.049, 0.035), (0.053, 0.065), (0.043, 0.1), (0.024, 0.13), (0.021, 0.15)]
    lip = [(0.027, 0.172), (0.034, 0.182), (0.032, 0.185), (0.023, 0.172), (0.017, 0.15), (0.016, 0.125), (0.0, 0.12)]
    return revolve(smooth_profile(outside + lip, 60), 40)


def pawn() -> Surface:
    angle = np.linspace(-0.33 * np.pi, np.pi / 2, 16)
    head = np.stack([0.019 * np.cos(angle), 0.084 + 0.019 * np.sin(angle)], -1)
    foot = [(0.0, 0.0), (0.031, 0.0), (0.034, 0.006), (0.032, 0.013), (0.024, 0.018), (0.015, 0.035), (0.012, 0.055), (0.013, 0.06)]
    collar = [(0.021, 0.062), (0.021, 0.066), (0.011, 0.0675)]
    return revolve(np.concatenate([smooth_profile(foot + collar, 40), head]), 32)


def trefoil(size: float, tube: float, along: int = 108, around: int = 14) -> Surface:
    """Trefoil knot in the x-z plane, centred at the origin."""

    def curve(t: np.ndarray) -> np.ndarray:
        return size / 3 * np.stack([np.sin(t) + 2 * np.sin(2 * t), -1.2 * np.sin(3 * t), np.cos(t) - 2 * np.cos(2 * t)], -1)

    t = np.linspace(0, 2 * np.pi, along + 1)
    delta = 1e-3
    tangent = curve(t + delta) - curve(t - delta)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    bend = curve(t + delta) - 2 * curve(t) + curve(t - delta)
    side = bend - (bend * tangent).sum(-1, keepdims=True) * tangent
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    other = np.cross(tangent, side)
    angle = np.linspace(0, 2 * np.pi, around + 1)[None, :, None]
    normals = np.cos(angle) * side[:, None] + np.sin(angle) * other[:, None]
    uv = np.stack(np.broadcast_arrays(t[:, None] / (2 * np.pi), angle[..., 0] / (2 * np.pi)), -1)
    return grid_surface(curve(t)[:, None] + tube * normals, normals, uv)


def cube(edge: float) -> Surface:
    """Axis-aligned cube standing on z = 0; each face has the whole uv square."""
    square = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]).reshape(2, 2, 2)
    parts = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            points = np.empty((2, 2, 3))
            points[..., axis] = sign
            points[..., (axis + 1) % 3] = 2 * square[..., 0] - 1
            points[..., (axis + 2) % 3] = 2 * square[..., 1] - 1
            normals = np.zeros_like(points)
            normals[..., axis] = sign
            parts.append(grid_surface(edge / 2 * (points + np.array([0.0, 0.0, 1.0])), normals, square))
    faces = np.concatenate([part.faces + 4 * i for i, part in enumerate(parts)])
    joined = [np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "normals", "uv")]
    return Surface(joined[0], joined[1], joined[2], faces)


def implicit(function: Callable[[np.ndarray], np.ndarray], low: list[float], high: list[float], cell: float) -> Surface:
    """Zero level of a function of points (..., 3) [m], negative inside."""
    axes = [np.arange(a, b, cell) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    vertices, faces, _, _ = marching_cubes(function(points), 0.0, spacing=(cell,) * 3)
    vertices = vertices + np.array(low)
    offsets = 0.25 * cell * np.eye(3)
    normals = np.stack([function(vertices + o) - function(vertices - o) for o in offsets], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    edges = vertices[faces]
    facing = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    if (facing * normals[faces[:, 0]]).sum() < 0:
        faces = faces[:, ::-1]
    return Surface(vertices, normals, vertices[:, :2] * 0.0, np.ascontiguousarray(faces))


def duck_body() -> Surface:
    """Body, tail and head of a rubber duck looking along +x, standing on z = 0."""
    parts = [  # centre, semi-axes [m]
        ((0.0, 0.0, 0.028), (0.046, 0.034, 0.028)),
        ((-0.04, 0.0, 0.044), (0.017, 0.016, 0.012)),
        ((0.02, 0.0, 0.07), (0.026, 0.025, 0.025)),
    ]

    def function(points: np.ndarray) -> np.ndarray:
        total = np.zeros(points.shape[:-1])
        for centre, axes in parts:
            q = (points - np.array(centre)) / np.array(axes)
            length = np.linalg.norm(q, axis=-1)
            total += np.exp(-(length - 1) * min(axes) / 0.005)
        return -0.005 * np.log(np.maximum(total, 1e-30))

    return implicit(function, [-0.07, -0.045, -0.008], [0.06, 0.045, 0.106], 0.004)


def ellipsoid(semi_axes: tuple[float, float, float], segments: int = 20) -> Surface:
    unit = ball(1.0, segments)
    normals = unit.vertices / np.array(semi_axes)
    return Surface(unit.vertices * np.array(semi_axes), normals / np.linalg.norm(normals, axis=-1, keepdims=True), unit.uv, unit.faces)


# -------------------------------------------------------------------------------------------------------- patterns


def table_patterns() -> tuple[np.ndarray, np.ndarray]:
    """(512, 512) weights of indigo and terracotta over cream, plan view."""
    y, x = np.mgrid[0:512, 0:512] / 255.5 - 1.0
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    petals = np.abs(np.cos(6 * angle))
    inner = (radius > 0.2) & (radius < 0.28 + 0.3 * petals)
    indigo = inner | ((radius > 0.66) & (radius < 0.7)) | ((radius > 0.72) & (radius < 0.93) & (np.sin(16 * angle) > 0))
    terracotta = (radius < 0.13) | ((radius > 0.36) & (radius < 0.26 + 0.24 * petals)) | (radius > 0.93)
    terracotta |= np.hypot(radius - 0.59, 0.59 * (((angle / np.pi * 6 + 0.5) % 1.0) - 0.5) * np.pi / 6) < 0.035
    return soften(indigo), soften(terracotta)


def vase_pattern() -> np.ndarray:
    """(256, 256) weight of cobalt over white glaze; columns around, rows along the profile from the foot."""
    height, u = np.mgrid[0:256, 0:256] / 256.0
    wave = np.abs(height - 0.31 - 0.045 * np.sin(2 * np.pi * 5 * u)) < 0.022
    bands = (np.abs(height - 0.2) < 0.012) | (np.abs(height - 0.43) < 0.016) | ((height > 0.55) & (height < 0.63))
    return soften(wave | bands | (height > 0.66))


def cube_pattern() -> np.ndarray:
    """(128, 128) weight of ink on paper: a ring and four corners."""
    y, x = np.mgrid[0:128, 0:128] / 63.5 - 1.0
    ring = np.abs(np.hypot(x, y) - 0.45) < 0.17
    corners = (np.abs(x) > 0.62) & (np.abs(y) > 0.62)
    return soften(ring | corners)


def soften(mask: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 1.0)


# ----------------------------------------------------------------------------------------------------------- scene


def load_mitsuba(variant: str = "llvm_ad_spectral_polarized") -> Any:
    """Mitsuba with a polarized spectral variant. LLVM 15 and older abort inside polarized kernels: a newer one is chosen."""
    if "DRJIT_LIBLLVM_PATH" not in os.environ and variant.startswith("llvm"):
        found = [(int(match[1]), path) for path in glob.glob("/usr/lib/*/libLLVM*.so*") if (match := re.search(r"LLVM-(\d+)", path))]
        if found and max(found)[0] >= 16:
            os.environ["DRJIT_LIBLLVM_PATH"] = max(found)[1]
    import mitsuba

    mitsuba.set_variant(variant)
    return mitsuba


def matte(paint: np.ndarray, nm: np.ndarray = WAVELENGTHS) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": spectrum(paint, nm)}


def coated(paint: np.ndarray, roughness: float = 0.12, nm: np.ndarray = WAVELENGTHS) -> dict[str, Any]:
    """A smooth or rough dielectric coat (n = 1.5) over a diffuse body; polarizes."""
    return {"type": "pplastic", "diffuse_reflectance": spectrum(paint, nm), "int_ior": 1.5, "alpha": roughness}


def blended(mi: Any, weight: np.ndarray, first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """``first`` where the weight map is 0, ``second`` where it is 1."""
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(weight[..., None].astype(np.float32)), "raw": True}
    return {"type": "blendbsdf", "weight": texture, "first": first, "second": second}


def brass() -> dict[str, Any]:
    """Rough conductor with a brass-like complex index of refraction."""
    eta = 0.45 + 1.0 * (1 - step(505, 14))
    k = 1.9 + 0.0055 * (WAVELENGTHS - 450.0)
    return {"type": "roughconductor", "eta": spectrum(eta), "k": spectrum(np.maximum(k, 1.7)), "alpha": 0.22, "distribution": "ggx"}


def parts(mi: Any) -> list[tuple[str, Surface, dict[str, Any]]]:
    """(label, surface in the gt frame [m], BSDF) of all things."""
    paint = reflectances()
    indigo, terracotta = table_patterns()
    wood = blended(mi, terracotta, blended(mi, indigo, matte(paint["cream"]), matte(paint["indigo"])), matte(paint["terracotta"]))
    seat = {name: (0.142 * np.cos(np.radians(a)), 0.142 * np.sin(np.radians(a))) for name, a in
            {"duck": -62, "sphere_a": -5, "pawn": 52, "knot": 115, "sphere_b": 172, "cube": 236}.items()}  # fmt: skip

    def at(name: str, z: float = 0.0) -> tuple[float, float, float]:
        return (*seat[name], z)

    duck_turn = -118.0
    c, s = np.cos(np.radians(duck_turn)), np.sin(np.radians(duck_turn))

    def on_duck(x: float, y: float, z: float) -> tuple[float, float, float]:
        return (seat["duck"][0] + c * x - s * y, seat["duck"][1] + s * x + c * y, z)

    return [
        ("table", table_top(0.225, 0.02), wood),
        ("vase", vase(), blended(mi, vase_pattern(), coated(paint["glaze"], 0.1), coated(paint["cobalt"], 0.1))),
        ("duck", duck_body().moved(at("duck"), duck_turn), coated(paint["yellow"], 0.2)),
        ("duck", ellipsoid((0.014, 0.013, 0.006)).moved(on_duck(0.048, 0.0, 0.067), duck_turn), coated(paint["orange"], 0.2)),
        ("duck", ball(0.0055, 16).moved(on_duck(0.0385, 0.0145, 0.0795)), coated(paint["black"])),
        ("duck", ball(0.0055, 16).moved(on_duck(0.0385, -0.0145, 0.0795)), coated(paint["black"])),
        ("sphere_a", ball(0.034).moved(at("sphere_a", 0.034)), coated(paint["teal_a"])),
        ("sphere_b", ball(0.034).moved(at("sphere_b", 0.034)), coated(paint["teal_b"])),
        ("pawn", pawn().moved(at("pawn")), brass()),
        ("knot", trefoil(0.04, 0.0125).moved(at("knot", 0.051), 25.0), coated(paint["coral"], 0.15)),
        ("cube", cube(0.06).moved(at("cube"), 20.0), blended(mi, cube_pattern(), coated(paint["paper"], 0.2), coated(paint["ink"], 0.2))),
    ]  # fmt: skip


def to_mitsuba(mi: Any, name: str, surface: Surface, bsdf: dict[str, Any]) -> Any:
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, len(surface.vertices), len(surface.faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = surface.vertices.astype(np.float32).ravel()
    parameters["vertex_normals"] = surface.normals.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = surface.uv.astype(np.float32).ravel()
    parameters["faces"] = surface.faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def lamps(mi: Any) -> dict[str, Any]:
    """Three soft boxes and a faint even light; the spectrum is in the responses, so radiance is 1 at all wavelengths."""
    white = np.ones_like(WAVELENGTHS)
    # position [m], half edge [m], radiance, share of the light on the table (where to send samples)
    boxes = {
        "rim": ((0.1, 0.95, 0.8), 0.2, 4.5, 0.16),
        "fill": ((-0.95, 0.1, 0.75), 0.3, 2.2, 0.18),
        "key": ((0.75, -0.55, 0.95), 0.26, 7.5, 0.45),
    }
    out: dict[str, Any] = {"sky": {"type": "constant", "radiance": spectrum(0.12 * white), "sampling_weight": 0.21}}
    for name, (position, half, power, share) in boxes.items():
        place = mi.ScalarTransform4f().look_at(origin=list(position), target=[0.0, 0.0, 0.05], up=[0.0, 0.0, 1.0])
        light = {"type": "area", "radiance": spectrum(power * white), "sampling_weight": share}
        out[name] = {"type": "rectangle", "to_world": place @ mi.ScalarTransform4f().scale([half, half, 1.0]), "emitter": light}
    return out


def load_scene(mi: Any, content: dict[str, Any]) -> Any:
    """Mitsuba scene with its lamps in the order given, so samples are the same every time: the optimizer sorts them by addresses."""
    return mi.load_dict({"type": "scene", **content}, optimize=False)


def build_scene(mi: Any) -> tuple[Any, list[tuple[Any, int]], list[tuple[str, Surface]]]:
    """Mitsuba scene, (shape, label) pairs and the surfaces."""
    things = parts(mi)
    meshes = [to_mitsuba(mi, f"part{i}", surface, bsdf) for i, (_, surface, bsdf) in enumerate(things)]
    scene = load_scene(mi, {**lamps(mi), **{f"part{i}": mesh for i, mesh in enumerate(meshes)}})
    shapes = {shape.id(): shape for shape in scene.shapes()}
    labelled = [(shapes[f"part{i}"], LABELS.index(name)) for i, (name, _, _) in enumerate(things)]
    return scene, labelled, [(name, surface) for name, surface, _ in things]


# --------------------------------------------------------------------------------------------------------- sensors


@dataclass(frozen=True)
class RigSensor:
    """A sensor of the rig. ``to_reference``: its camera → RGB camera, 4×4 [m], OpenCV axes."""

    name: str
    title: str
    camera: Camera
    pattern: np.ndarray
    to_reference: np.ndarray
    responses: np.ndarray  # (C, wavelengths)
    bits: int = 12

    @property
    def polarized(self) -> bool:
        return self.name == "polarization"


def look_at(position: np.ndarray, target: np.ndarray, roll_deg: float = 0.0) -> np.ndarray:
    """Camera-to-world 4×4, OpenCV axes, z up. Positive roll turns the camera counter-clockwise seen from behind."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    pose = np.eye(4)
    pose[:3, 0] = c * right - s * down
    pose[:3, 1] = s * right + c * down
    pose[:3, 2] = forward
    pose[:3, 3] = position
    return pose


def rig() -> list[RigSensor]:
    """The five sensors, RGB first (the reference). The others stand 6 cm around it and look at the same point."""
    curves = responses()

    def toe_in(x: float, y: float, roll_deg: float) -> np.ndarray:
        position = np.array([x, y, 0.0])
        forward = np.array([0.0, 0.0, 0.74]) - position
        forward /= np.linalg.norm(forward)
        down = np.array([0.0, 1.0, 0.0]) - forward[1] * forward
        down /= np.linalg.norm(down)
        right = np.cross(down, forward)
        c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
        pose = np.eye(4)
        pose[:3, :3] = np.stack([c * right - s * down, s * right + c * down, forward], -1)
        pose[:3, 3] = position
        return pose

    def sensor(
        name: str,
        title: str,
        size: tuple[int, int],
        focal: tuple[float, float],
        centre: tuple[float, float],
        brown: tuple[float, float, float, float],
        pattern: list[list[int]],
        place: np.ndarray,
        bits: int = 12,
    ) -> RigSensor:
        # brown: k1 k2 p1 p2
        camera = Camera(*size, *focal, *centre, (*brown, 0.0, 0.0))
        return RigSensor(name, title, camera, np.array(pattern), place, curves[name], bits)

    return [
        sensor("rgb", "SynBayer", (96, 72), (136.5, 136.2), (47.9, 35.2), (-0.11, 0.08, 0.0006, -0.0008), [[1, 2], [0, 1]], np.eye(4)),
        sensor("infrared", "SynNIR", (96, 76), (134.8, 135.1), (46.8, 38.1), (-0.19, 0.13, -0.0007, 0.0005), [[0]],
               toe_in(0.06, 0.008, 1.0)),
        sensor("mono", "SynMono", (96, 72), (137.8, 137.6), (48.3, 36.0), (-0.09, 0.06, 0.0004, 0.0007), [[0]],
               toe_in(-0.058, 0.004, -0.8)),
        sensor("polarization", "SynPol", (92, 76), (132.0, 132.5), (45.1, 37.2), (-0.15, 0.11, 0.0008, -0.0003), [[2, 1], [3, 0]],
               toe_in(0.006, 0.055, 1.5), 16),
        sensor("multispectral", "SynMS", (93, 75), (130.9, 131.4), (46.4, 36.5), (-0.22, 0.16, -0.0005, -0.0008),
               [[4, 5, 6], [2, 1, 0], [3, 8, 7]], toe_in(-0.007, -0.06, -1.2)),
    ]  # fmt: skip


def rig_poses() -> list[np.ndarray]:
    """RGB camera-to-gt poses [m] of all views: a low ring, then a high one, with some play in angle, distance and roll."""
    rng = np.random.default_rng(7)
    poses = []
    for view in range(VIEWS):
        ring, place = divmod(view, VIEWS // 2)
        azimuth = np.radians(30.0 * place + 15.0 * ring + rng.uniform(-4, 4) - 90.0)
        elevation = np.radians((24.0, 50.0)[ring] + rng.uniform(-3, 3))
        distance = 0.74 + rng.uniform(-0.015, 0.015)
        target = np.array([0.0, 0.0, (0.036, 0.014)[ring]]) + rng.uniform(-0.006, 0.006, 3)
        direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        poses.append(look_at(target + distance * direction, target, rng.uniform(-5, 5)))
    return poses


# ------------------------------------------------------------------------------------------------------- rendering


def wavelength_table(response: np.ndarray, nm: np.ndarray = WAVELENGTHS) -> np.ndarray:
    """Responses (C, wavelengths) → inverse cumulative distributions (C, TABLE_BINS + 1) [nm]."""
    fine = np.linspace(nm[0], nm[-1], 8001)
    out = []
    for curve in response:
        density = np.interp(fine, nm, curve)
        total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
        keep = np.concatenate([[True], np.diff(total) > 0])
        out.append(np.interp(np.linspace(0, 1, TABLE_BINS + 1), total[keep] / total[-1], fine[keep]))
    return np.stack(out)


def trace(mi: Any, scene: Any, camera: Camera, pose: np.ndarray, spp: int, seed: int,
          wavelengths: Callable[[Any, Any], list[Any]]) -> Iterator[tuple[list[Any], Any]]:  # fmt: skip
    """Paths of a scene through a lens, in blocks of samples; the samples of a photosite lie beside each other (see `photosite_sums`).

    Args:
        pose: (4, 4) camera-to-scene, OpenCV axes.
        spp: samples per pixel, a square number.
        wavelengths: (index of the photosite, a random number in [0, 1)) → four wavelengths [nm] of each sample. Which way a path goes does
            not depend on them: the same seed gives the same paths.
    Yields:
        The wavelengths, and the paths' Mueller matrices to the axes of `mmsynth.sensors.polarization` (x̂ = camera x ⟂ ray, ŷ = image up).
    """
    import drjit as dr

    if int(np.sqrt(spp)) ** 2 != spp:
        raise ValueError(f"spp = {spp}, expected a square number")
    v, u = np.mgrid[0 : camera.height + 1, 0 : camera.width + 1] - 0.5
    corners, valid = unproject(np.stack([u, v], -1), camera)
    if not valid.all():
        raise ValueError("the lens has no ray for a pixel corner")
    corner_x, corner_y = mi.Float(corners[..., 0].ravel()), mi.Float(corners[..., 1].ravel())
    pixels = camera.width * camera.height
    block = max(n for n in range(1, 145) if spp % n == 0)
    integrator = mi.load_dict({"type": "path", "max_depth": PATH_DEPTH, "rr_depth": 100, "hide_emitters": True})
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    sampler.set_samples_per_wavefront(block)
    sampler.seed(seed, pixels * block)
    matrix = [[dr.opaque(mi.Float, float(pose[i, j])) for j in range(4)] for i in range(3)]
    width = dr.opaque(mi.UInt32, camera.width)
    for _ in range(spp // block):
        pixel = dr.arange(mi.UInt32, pixels * block) // block  # the sampler's own layout
        column, row = pixel % width, pixel // width
        fx, fy = sampler.next_2d()
        corner = row * (width + 1) + column
        ideal = []
        for values in (corner_x, corner_y):
            top = dr.lerp(dr.gather(mi.Float, values, corner), dr.gather(mi.Float, values, corner + 1), fx)
            bottom = dr.lerp(dr.gather(mi.Float, values, corner + width + 1), dr.gather(mi.Float, values, corner + width + 2), fx)
            ideal.append(dr.lerp(top, bottom, fy))
        direction = dr.normalize(mi.Vector3f(*[m[0] * ideal[0] + m[1] * ideal[1] + m[2] for m in matrix]))
        ray = mi.RayDifferential3f(mi.Point3f(*[m[3] + dr.zeros(mi.Float, pixels * block) for m in matrix]), direction)
        chosen = wavelengths(pixel, sampler.next_1d())
        for k in range(4):
            ray.wavelengths[k] = chosen[k]
        mueller, _, _ = integrator.sample(scene, sampler, ray)
        # Mitsuba's Stokes frame: light travels along -direction; turn its basis to the camera's x axis
        camera_x = mi.Vector3f(*[m[0] for m in matrix])
        x_axis = dr.normalize(camera_x - dr.dot(camera_x, direction) * direction)
        yield chosen, mi.mueller.rotate_stokes_basis(-direction, mi.mueller.stokes_basis(-direction), x_axis) @ mueller
        sampler.advance()
        sampler.schedule_state()


def photosite_sums(values: list[Any], camera: Camera) -> np.ndarray:
    """Numbers of each sample of a block of `trace` → (photosites, numbers) float64, summed over the samples."""
    import drjit as dr

    dr.eval(*values)
    return np.stack([np.array(v, dtype=np.float64).reshape(camera.width * camera.height, -1).sum(1) for v in values], -1)


def render(mi: Any, scene: Any, camera: Camera, pose: np.ndarray, table: np.ndarray, channel: np.ndarray, spp: int, seed: int,
           clamp: float = np.inf) -> np.ndarray:  # fmt: skip
    """Stokes images of a scene through a lens, noise-free but for the sampling.

    Args:
        pose, spp: see `trace`.
        table: (C, TABLE_BINS + 1) of `wavelength_table`. channel: (H, W) int, the channel each photosite measures.
        clamp: limit of S0 of one sample at one wavelength.
    Returns:
        (H, W, 3) float64: S0, S1, S2 in the axes of `mmsynth.sensors.polarization`.
    """
    import drjit as dr

    nanometres, channels = mi.Float(table.ravel()), mi.UInt32(channel.ravel())
    limit = dr.opaque(mi.Float, min(clamp, 1e30))

    def of_response(pixel: Any, shift: Any) -> list[Any]:
        """Four stratified draws from the photosite's response."""
        out, own = [], dr.gather(mi.UInt32, channels, pixel) * (TABLE_BINS + 1)
        for k in range(4):
            position = (k + shift) / 4 * TABLE_BINS
            cell = dr.minimum(mi.UInt32(position), TABLE_BINS - 1)
            below, above = dr.gather(mi.Float, nanometres, own + cell), dr.gather(mi.Float, nanometres, own + cell + 1)
            out.append(dr.lerp(below, above, position - mi.Float(cell)))
        return out

    total = np.zeros((camera.width * camera.height, 3))
    for _, mueller in trace(mi, scene, camera, pose, spp, seed, of_response):
        shrink = dr.minimum(1.0, limit / dr.maximum(mueller[0, 0], 1e-20))
        total += photosite_sums([dr.mean(mueller[i, 0] * shrink) for i in range(3)], camera)
    return (total / spp).reshape(camera.height, camera.width, 3)


def first_hit(mi: Any, scene: Any, labelled: list[tuple[Any, int]], camera: Camera, pose: np.ndarray) -> dict[str, np.ndarray]:
    """depth_z, depth_ray [m] (0: none), shading normal (gt axes), label and in_roi along the ray of each pixel centre."""
    directions = ray_map(camera)[0].reshape(-1, 3)
    world = directions @ pose[:3, :3].T
    ray = mi.Ray3f(mi.Point3f(*[mi.Float(np.full(len(world), x)) for x in pose[:3, 3]]), mi.Vector3f(*[mi.Float(w) for w in world.T]))
    hit = scene.ray_intersect(ray)
    label = np.zeros(len(world), np.uint8)
    for shape, value in labelled:
        label[np.array(hit.shape == mi.ShapePtr(shape))] = value
    seen = label > 0
    distance = np.where(seen, np.array(hit.t), 0.0)
    normal = np.where(seen[:, None], np.array(hit.sh_frame.n).T, 0.0)
    points = pose[:3, 3] + distance[:, None] * world
    in_roi = seen & (np.linalg.norm(points - WORLD_OFFSET, axis=-1) <= WORLD_SCALE)
    shape2 = (camera.height, camera.width)
    return {
        "depth_z": (distance * directions[:, 2]).astype(np.float32).reshape(shape2),
        "depth_ray": distance.astype(np.float32).reshape(shape2),
        "normal": normal.astype(np.float16).reshape(*shape2, 3),
        "label": label.reshape(shape2),
        "in_roi": in_roi.reshape(shape2),
    }  # fmt: skip


def photosites(sensor: RigSensor, stokes: np.ndarray) -> np.ndarray:
    """Stokes (H, W, 3) rendered with each photosite's own response → the light each photosite measures (H, W)."""
    if not sensor.polarized:
        return stokes[..., 0]
    intensities = stokes_to_intensities(torch.from_numpy(stokes), POLARIZER_DEG).numpy()
    return np.take_along_axis(intensities, channel_map(sensor.pattern, *stokes.shape[:2])[..., None], 2)[..., 0]


def own_channels(sensor: RigSensor) -> np.ndarray:
    """(H, W) row of the response table at each photosite: 0 for polarization, whose channels share one response."""
    shape = (sensor.camera.height, sensor.camera.width)
    return np.zeros(shape, np.int64) if sensor.polarized else channel_map(sensor.pattern, *shape)


def measure(light: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    """Light (1.0 = full scale) → noisy 16-bit codes; 12-bit codes are aligned to the top."""
    electrons = rng.poisson(np.maximum(light, 0.0) * FULL_WELL) + rng.normal(0.0, READ_NOISE, light.shape)
    value = np.clip(electrons / FULL_WELL, 0.0, 1.0)
    return (np.round(value * (2**bits - 1)).astype(np.uint16) << (16 - bits)).astype(np.uint16)


# ----------------------------------------------------------------------------------------------------------- files


def rounded(value: np.ndarray) -> list[Any]:
    return np.round(np.asarray(value, dtype=np.float64), 12).tolist()


def meta_data(sensors: list[RigSensor], poses: list[np.ndarray], low: np.ndarray, high: np.ndarray) -> dict[str, Any]:
    """meta_data.json; low, high: corners of the scene in world units."""
    to_gt = np.diag([WORLD_SCALE] * 3 + [1.0])
    to_gt[:3, 3] = WORLD_OFFSET
    modalities = {}
    for sensor in sensors:
        frames = []
        for view, pose in enumerate(poses):
            camera_to_gt = pose @ sensor.to_reference @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes
            camera_to_gt[:3, 3] = (camera_to_gt[:3, 3] - WORLD_OFFSET) / WORLD_SCALE
            frames.append({"frame_id": view, "file_name": f"{view:04d}.png", "camtoworld": rounded(camera_to_gt[:3])})
        modalities[sensor.name] = {**lens(sensor), "frames": frames}
    box = {"aabb": [rounded(low), rounded(high)], "collider_type": "sphere", "radius": 1.0}
    return {"undistorted": False, "raw": True, "pixel_offset": 0.0, "scene_box": box, "worldtogt": rounded(to_gt), "modalities": modalities}


def lens(sensor: RigSensor) -> dict[str, Any]:
    c = sensor.camera
    return {"camera_model": "OPENCV", "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
            "distortion_params": list(c.distortion), "mosaick_pattern": sensor.pattern.tolist()}  # fmt: skip


def orbit(camera: Camera, views: int = 12) -> dict[str, Any]:
    """nerfstudio transforms.json: one turn around the scene, gt frame [m], OpenGL axes, pixel centres at 0.5."""
    frames = []
    for view in range(views):
        azimuth, elevation = 2 * np.pi * view / views - np.pi / 2, np.radians(34.0 + 8.0 * np.sin(2 * np.pi * view / views))
        target = np.array([0.0, 0.0, 0.04])
        offset = 0.74 * np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        pose = look_at(target + offset, target) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"orbit/{view:04d}.png", "transform_matrix": rounded(pose)})
    return {"camera_model": "PINHOLE", "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy,
            "cx": camera.cx + 0.5, "cy": camera.cy + 0.5, "frames": frames}  # fmt: skip


README = """# The example scene

Seven small things on a painted table, seen by five sensors on a rig. Made by `examples/render_example_scene.py` (Mitsuba 3,
spectral and polarized path tracing); geometry, spectra and patterns are generated there, no outside material. Apache-2.0, like mmsynth.
{views} views on two rings (0-11 low, 12-23 high), test views {test}. Path depth {depth}; raw frames {spp} samples per pixel,
truth {gt_spp}. Every sample is clamped at {clamp} x full scale per wavelength, in frames and truth alike. Around the objects is
black: everything visible lies in the region of interest.

Look for: the two teal spheres, equal in RGB and different in the multispectral and infrared frames; the ink of the cube and the
indigo of the table, which vanish in the infrared; polarization of the coats and of the brass pawn.

## Files
- `meta_data.json`, `calibration.json`, `modalities/<sensor>/NNNN.png`: MMS-DATA, raw (mosaicked, distorted).
- `sensors.json`: responses (times the lamp's spectrum), gains, noise.
- `poses.json`: an orbit of 12 views to render, as nerfstudio's `transforms.json` (OpenGL axes, pixel centres at 0.5), in the gt
  frame (metres), RGB intrinsics without distortion.
- `gt/<sensor>/VVVV.npz`: `data` (H, W, C) float16 without sensor noise, all channels at every pixel, at the test views.
  Polarization: S0, S1, S2. `gt/aligned/VVVV.npz`: the other modalities seen from the RGB camera (pose, intrinsics, distortion).
- `gt/geometry/VVVV.npz` (RGB camera): `depth_z`, `depth_ray` [m], 0 = none; `normal` (gt axes); `label`; `in_roi`.
  `gt/masks/VVVV_<sensor>.npz`: `label`, `in_roi`. `gt/labels.json`. `gt/mesh_foreground.ply`: all surfaces, world units.

## Conventions
- gt frame: metres, z up, table top z = 0. gt = 0.27 * world + [0, 0, 0.105] (`worldtogt`); the region of interest is the unit
  sphere of world.
- `camtoworld` (3, 4): world units, camera axes x right, y up, z back. `camera2reference` (4, 4): sensor to RGB camera, metres,
  x right, y down, z forward.
- The centre of the top-left pixel is (0, 0); a value is the mean over the pixel's square.
- Distortion [k1, k2, p1, p2, k3, k4], OpenCV order. Mosaic: channel = pattern[row % h][column % w].
- Raw PNG: 16 bit, linear, value / 65535 = fraction of full scale, black level 0; 12-bit codes << 4, polarization 16 bit.
  Noise: Poisson ({well:.0f} electrons at full scale) and {read:.0f} electrons of read noise. Fixed exposure: 99.5 percentile of
  a modality near {target}. The path tracer's own noise comes on top: together about twice the sensor noise (raw against truth
  is 36 to 39 dB in the region of interest, the ceiling of any PSNR against raw frames). Truth uses the same unit and is not clipped at 1.
- rgb 0..2 = R, G, B. polarization 0..3 = 0, 45, 90, 135 degrees. multispectral 0..7 = 692, 653, 611, 572, 541, 503, 464,
  431 nm, 8 = panchromatic.
- Stokes: the first axis is the camera's x axis projected perpendicular to the ray, the second points towards image up; angles
  run from image right towards image up. I(a) = (S0 + S1 cos 2a + S2 sin 2a) / 2.
"""


def readme(spp: int, gt_spp: int) -> str:
    return README.format(views=VIEWS, test=", ".join(map(str, TEST_VIEWS)), depth=PATH_DEPTH, spp=spp, gt_spp=gt_spp, clamp=CLAMP,
                         well=FULL_WELL, read=READ_NOISE, target=EXPOSURE_TARGET)  # fmt: skip


def write_json(path: Path, content: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content, indent=1)
    # numbers of one list on one line
    text = re.sub(r"\[\s+(-?[\d.e+-]+(?:,\s+-?[\d.e+-]+)*)\s+\]", lambda m: "[" + re.sub(r"\s+", " ", m[1]) + "]", text)
    path.write_text(text + "\n")


def write_npz(path: Path, **arrays: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "example_scene")
    parser.add_argument("--spp", type=int, default=196, help="samples per pixel of raw frames, a square number")
    parser.add_argument("--gt-spp", type=int, default=400, help="samples per pixel of the truth, a square number")
    parser.add_argument("--views", type=int, nargs="*", default=list(range(VIEWS)), help="render these views only (for a look)")
    parser.add_argument("--variant", default="llvm_ad_spectral_polarized")
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    arguments = parser.parse_args()
    out: Path = arguments.out
    began = time.perf_counter()
    mi = load_mitsuba(arguments.variant)
    if arguments.threads:
        import drjit

        drjit.set_thread_count(arguments.threads)
    scene, labelled, surfaces = build_scene(mi)
    sensors, poses = rig(), rig_poses()
    tables = [wavelength_table(sensor.responses) for sensor in sensors]

    def say(text: str) -> None:
        print(f"[{time.perf_counter() - began:6.1f} s] {text}", flush=True)

    # exposure: one gain per sensor from a rough look at four views
    gains = []
    for number, sensor in enumerate(sensors):
        looks = [render(mi, scene, sensor.camera, poses[view] @ sensor.to_reference, tables[number], own_channels(sensor), 16, 9000 + view)
                 for view in (2, 7, 14, 21)]  # fmt: skip
        bright = np.percentile([photosites(sensor, look) for look in looks], 99.5)
        gains.append(float(np.round(EXPOSURE_TARGET / bright, 6)))
    say(f"gains {dict(zip([s.name for s in sensors], gains, strict=True))}")

    vertices = np.concatenate([(s.vertices - WORLD_OFFSET) / WORLD_SCALE for _, s in surfaces])
    if np.linalg.norm(vertices, axis=-1).max() > 1:
        raise ValueError("a surface leaves the region of interest")
    offsets = np.cumsum([0] + [len(s.vertices) for _, s in surfaces[:-1]])
    mesh = trimesh.Trimesh(vertices, np.concatenate([s.faces + o for (_, s), o in zip(surfaces, offsets, strict=True)]), process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    (out / "gt").mkdir(parents=True, exist_ok=True)
    mesh.export(out / "gt/mesh_foreground.ply", vertex_normal=False)
    write_json(out / "meta_data.json", meta_data(sensors, poses, vertices.min(0), vertices.max(0)))
    calibration = {s.name: {"sensor": s.title, **lens(s), "camera2reference": rounded(s.to_reference)} for s in sensors}
    write_json(out / "calibration.json", calibration)
    write_json(out / "poses.json", orbit(sensors[0].camera))
    write_json(out / "gt/labels.json", {str(i): name for i, name in enumerate(LABELS)})
    exposure = {s.name: {"gain": gain, "bits": s.bits, "response_times_lamp": np.round(s.responses, 6).tolist()}
                for s, gain in zip(sensors, gains, strict=True)}  # fmt: skip
    noise = {"full_well_electrons": FULL_WELL, "read_noise_electrons": READ_NOISE}
    write_json(out / "sensors.json", {"wavelengths_nm": rounded(WAVELENGTHS), **noise, "sensors": exposure})
    (out / "README.md").write_text(readme(arguments.spp, arguments.gt_spp))

    for number, (sensor, table, gain) in enumerate(zip(sensors, tables, gains, strict=True)):
        folder = out / "modalities" / sensor.name
        folder.mkdir(parents=True, exist_ok=True)
        for view in arguments.views:
            seed = 100 * number + view
            pose = poses[view] @ sensor.to_reference
            stokes = render(mi, scene, sensor.camera, pose, table, own_channels(sensor), arguments.spp, 1 + seed, CLAMP / gain)
            raw = measure(gain * photosites(sensor, stokes), sensor.bits, np.random.default_rng(seed))
            cv2.imwrite(str(folder / f"{view:04d}.png"), raw, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        say(f"{sensor.name}: {len(arguments.views)} raw frames")

    def truth(number: int, camera: Camera, pose: np.ndarray, seed: int) -> np.ndarray:
        """(H, W, C) float16, C = channels or the three Stokes components."""
        shape = (camera.height, camera.width)
        images = [render(mi, scene, camera, pose, tables[number], np.full(shape, c), arguments.gt_spp, seed + c, CLAMP / gains[number])
                  for c in range(len(tables[number]))]  # fmt: skip
        image = images[0] if sensors[number].polarized else np.concatenate([i[..., :1] for i in images], -1)
        return (gains[number] * image).astype(np.float16)

    for view in [view for view in TEST_VIEWS if view in arguments.views]:
        spp = np.int64(arguments.gt_spp)
        aligned = {}
        for number, sensor in enumerate(sensors):
            pose = poses[view] @ sensor.to_reference
            geometry = first_hit(mi, scene, labelled, sensor.camera, pose)
            write_npz(out / f"gt/masks/{view:04d}_{sensor.name}.npz", label=geometry["label"], in_roi=geometry["in_roi"])
            image = truth(number, sensor.camera, pose, 20000 + 1000 * number + 20 * view)
            write_npz(out / f"gt/{sensor.name}/{view:04d}.npz", data=image, spp=spp)
            if number == 0:
                write_npz(out / f"gt/geometry/{view:04d}.npz", **geometry)
            else:
                aligned[sensor.name] = truth(number, sensors[0].camera, poses[view], 40000 + 1000 * number + 20 * view)
        write_npz(out / f"gt/aligned/{view:04d}.npz", **aligned, spp=spp)
        say(f"truth of view {view}")
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    say(f"{out}: {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
