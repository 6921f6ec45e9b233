"""Renders many small random scenes with truth: what a prior over scenes is learned from (what RGB says about the other modalities).

    python examples/render_prior_scenes.py OUT [--scenes 24] [--seed 0] [--scale 0.67] [--spp 100]

Needs what `render_example_scene.py` needs, whose meshes, camera model, path tracing and files these are; 27 s a scene on one core.
Scene i of seed s is always the same, in the folder OUT/s_iiii. A scene that is there is skipped; a killed run continues.

A scene: five to eight things on a table, one to four lamps, a room around them or none. Paints are matte or under a glossy coat, which
polarizes; metals are rough. Reflectances are random members of families (pigments of Kubelka-Munk, dyes, woods, leaves, skin, narrow
bands); what a paint does in the infrared is drawn apart from its visible colour, for that is what a prior has to be unsure of. Some pairs
of things differ in the infrared only, some are metamers of the colour camera.

Sensors have the responses of the packaged files `mmsdata_*.toml`, cut at 1000 nm. The unfiltered photosite of the multispectral camera,
which has none there, has that of the infrared camera: the two have one sensor by those files. Polarizers are ideal.
One unit for all modalities and scenes:

    value = gain[modality] * integral of radiance(nm) * response(nm) over nm,

with radiance 1, on average over 400 to 700 nm, for a perfect white that lies flat in the middle of the empty table under the lamps alone
(what walls and things add or hide is in the truth, not in that number).
`exposure.json` has the gains and that white in each channel, `sensors.json` also responses, the light on that white, and the lamps.

How: truth is traced at a comb of 16 wavelengths, shifted at random from sample to sample, and all channels are sums over the same paths. So
the noise of channels goes together, and their ratios have less of it.
"""

from __future__ import annotations

import argparse
import functools
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import render_example_scene as example
from render_example_scene import RigSensor, Surface

from mmsynth.sensors.camera import Camera
from mmsynth.sensors.sensor_file import find_sensor_file, load_sensor

NM = np.arange(400.0, 1001.0, 5.0)
VIEWS = 8
TEST_VIEWS = (2, 5)
RAW_SPP = 16  # of raw frames: their own noise is not what is learned
CLAMP = 8.0  # times the radiance of white, per path sample and wavelength (fireflies)
TEETH = 16  # of the comb of wavelengths, four of them per pass
TABLE_RADIUS = 0.225  # m
DARKEST, BRIGHTEST = 0.005, 0.97  # of a paint

bump = functools.partial(example.bump, nm=NM)
step = functools.partial(example.step, nm=NM)
spectrum = functools.partial(example.spectrum, nm=NM)


# ---------------------------------------------------------------------------------------------------------- paints


def opaque_layer(absorption: np.ndarray) -> np.ndarray:
    """Reflectance of an opaque layer by its absorption over scattering (Kubelka and Munk)."""
    return 1.0 + absorption - np.sqrt(absorption**2 + 2.0 * absorption)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def infrared_absorption(rng: np.random.Generator) -> np.ndarray:
    """None, a wide band or all of the infrared, whatever is absorbed in the visible."""
    kind = rng.choice(3, p=(0.45, 0.3, 0.25))
    if kind == 0:
        return np.zeros_like(NM)
    if kind == 1:
        return log_uniform(rng, 0.3, 15) * bump(rng.uniform(780, 1050), rng.uniform(60, 200))
    return log_uniform(rng, 0.5, 10) * step(rng.uniform(690, 850), rng.uniform(10, 50))


def pigment(rng: np.random.Generator) -> np.ndarray:
    """A few absorption bands in the visible."""
    absorption = log_uniform(rng, 0.003, 0.05) + log_uniform(rng, 0.1, 10) * (1 - step(rng.uniform(385, 420), 12))
    for _ in range(rng.integers(1, 4)):
        absorption = absorption + log_uniform(rng, 0.2, 16) * bump(rng.uniform(400, 700), rng.uniform(18, 70))
    return opaque_layer(absorption + infrared_absorption(rng))


def warm(rng: np.random.Generator) -> np.ndarray:
    """Yellow, orange and red: dark up to an edge."""
    edge = step(rng.uniform(470, 650), rng.uniform(5, 16))
    return opaque_layer(log_uniform(rng, 0.01, 0.1) + log_uniform(rng, 2, 30) * (1 - edge) + infrared_absorption(rng))


def cool(rng: np.random.Generator) -> np.ndarray:
    """Blue and green: one peak, and any level in the infrared."""
    peak = rng.uniform(0.15, 0.6) * bump(rng.uniform(435, 560), rng.uniform(25, 55))
    return rng.uniform(0.02, 0.1) + peak + rng.uniform(0.0, 0.8) * step(rng.uniform(680, 820), rng.uniform(8, 30))


def black_dye(rng: np.random.Generator) -> np.ndarray:
    """Black to the eye and bright in the infrared."""
    return rng.uniform(0.02, 0.06) + rng.uniform(0.3, 0.8) * step(rng.uniform(680, 800), rng.uniform(8, 25))


def neutral(rng: np.random.Generator) -> np.ndarray:
    """White, grey or carbon black, with a slight slope; whites absorb towards the ultraviolet."""
    level = (rng.uniform(0.72, 0.92), rng.uniform(0.1, 0.6), rng.uniform(0.02, 0.08))[rng.integers(3)]
    return level * (1 + rng.uniform(-0.1, 0.1) * (NM - 700) / 300) * step(rng.uniform(370, 405), 8)


def wood(rng: np.random.Generator) -> np.ndarray:
    low = rng.uniform(0.03, 0.15)
    return low + (rng.uniform(0.4, 0.75) - low) * step(rng.uniform(540, 690), rng.uniform(55, 120))


def leaf(rng: np.random.Generator) -> np.ndarray:
    """Chlorophyll and carotenoids, the red edge, and water at 970 nm."""
    green = bump(435, 25) + 0.8 * bump(475, 25) + 0.3 * bump(560, 60) + 0.5 * bump(625, 30) + bump(674, 16)
    water = rng.uniform(0.02, 0.2) * bump(970, 25)
    return opaque_layer(log_uniform(rng, 0.04, 0.25) + log_uniform(rng, 0.7, 8) * green + water)


def skin(rng: np.random.Generator) -> np.ndarray:
    """Melanin, blood and water."""
    melanin = log_uniform(rng, 0.03, 3) * (NM / 550.0) ** -3.5
    blood = log_uniform(rng, 0.05, 0.6) * (2 * bump(415, 15) + 0.45 * bump(542, 13) + 0.5 * bump(577, 9))
    return opaque_layer(0.04 + melanin + blood + 0.08 * bump(970, 30))


def narrow_bands(rng: np.random.Generator) -> np.ndarray:
    """Lines as of neodymium and praseodymium in glass."""
    out = rng.uniform(0.5, 0.85) * np.ones_like(NM)
    for centre in (525, 583, 742, 805, 875):
        out *= 1 - rng.uniform(0.3, 0.9) * bump(centre + rng.uniform(-6, 6), rng.uniform(6, 12))
    return out


FAMILIES: dict[Callable[[np.random.Generator], np.ndarray], float] = {
    pigment: 0.28, warm: 0.14, cool: 0.12, black_dye: 0.07, neutral: 0.17, wood: 0.06, leaf: 0.08, skin: 0.04, narrow_bands: 0.04,
}  # fmt: skip


def paint(rng: np.random.Generator) -> np.ndarray:
    """A random reflectance at NM in [DARKEST, BRIGHTEST]: of one family, or now and then a mixture of two."""
    families, odds = list(FAMILIES), np.array(list(FAMILIES.values()))
    first, second = (families[i](rng) for i in rng.choice(len(families), 2, p=odds / odds.sum()))
    share = rng.uniform(0.2, 0.8) if rng.random() < 0.15 else 1.0
    return np.clip(share * first + (1 - share) * second, DARKEST, BRIGHTEST)


def infrared_twin(rng: np.random.Generator, of: np.ndarray) -> np.ndarray:
    """A paint of the same visible colour with an infrared of its own."""
    seam = step(rng.uniform(700, 730), rng.uniform(4, 8))
    level = rng.uniform(0.04, 0.85) * (1 + rng.uniform(-0.2, 0.2) * (NM - 850) / 150)
    return np.clip(of * (1 - seam) + level * seam, DARKEST, BRIGHTEST)


def metamer(rng: np.random.Generator, of: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """A paint with the same sums of ``weights`` (3, wavelengths), which are responses times light, and another spectrum."""
    change = sum(rng.uniform(-1, 1) * bump(rng.uniform(410, 690), rng.uniform(15, 35)) for _ in range(5))
    change = change + rng.uniform(-1, 1) * step(rng.uniform(700, 780), 12)
    peaks = np.stack([bump(455, 30), bump(535, 30), bump(605, 30)])
    change -= np.linalg.solve(weights @ peaks.T, weights @ change) @ peaks
    room = np.where(change > 0, BRIGHTEST - of, of - DARKEST) / np.maximum(np.abs(change), 1e-9)
    return of + 0.95 * room.min() * change


def metal(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Real and imaginary index of refraction at NM: Drude's free electrons and Lorentz oscillators, rounded so that colours look right."""
    # plasma energy, damping [eV], permittivity at high energies, oscillators (strength, energy, width [eV])
    kinds: list[tuple[float, float, float, list[tuple[float, float, float]]]] = [
        (9.0, 0.05, 4.0, []),  # as silver
        (8.8, 0.09, 5.0, [(1.7, 3.0, 0.9)]),  # gold
        (8.6, 0.1, 5.0, [(1.1, 2.55, 0.7), (1.5, 3.5, 1.5)]),  # copper
        (8.3, 0.25, 4.5, [(1.2, 3.0, 1.1)]),  # brass
        (14.0, 0.6, 1.0, [(6.0, 1.55, 0.4)]),  # aluminium
        (7.0, 1.8, 2.0, [(6.0, 2.2, 3.0), (3.0, 1.2, 1.5)]),  # iron
        (5.5, 1.5, 2.0, [(8.0, 1.7, 2.2)]),  # titanium
    ]
    plasma, damping, high, oscillators = kinds[rng.integers(len(kinds))]
    energy = 1239.84 / NM
    vary = lambda: rng.uniform(0.95, 1.05)
    permittivity = high - (plasma * vary()) ** 2 / (energy**2 + 1j * damping * log_uniform(rng, 0.7, 2) * energy)
    for strength, place, width in oscillators:
        place *= vary()
        permittivity = permittivity + strength * vary() * place**2 / (place**2 - energy**2 - 1j * width * energy)
    index = np.sqrt(permittivity)
    return index.real, np.abs(index.imag)


# ----------------------------------------------------------------------------------------------------------- lamps


@dataclass(frozen=True)
class Lamp:
    """A square lamp that faces the middle of the table; no position: the same light from everywhere.

    ``share``: of the light on the empty table. ``spectrum``: at NM, 1 on average over 400 to 700 nm.
    """

    kind: str
    spectrum: np.ndarray
    share: float
    position: tuple[float, float, float] | None = None  # m
    half_edge: float = 0.0  # m

    def hides(self, other: Lamp) -> bool:
        """Whether one may stand before the other, seen from the middle of the table."""
        places = [np.array(lamp.position) for lamp in (self, other)]
        lengths = [np.linalg.norm(place) for place in places]
        reach = sum(np.arctan(np.sqrt(2) * lamp.half_edge / length) for lamp, length in zip((self, other), lengths, strict=True))
        return bool(places[0] @ places[1] > np.cos(reach) * lengths[0] * lengths[1])

    def radiance(self) -> np.ndarray:
        """At NM, such that a white that lies flat in the middle of the table has the radiance share × spectrum of it."""
        if self.position is None:
            return self.share * self.spectrum
        place = example.look_at(np.array(self.position), np.zeros(3))
        grid = (np.arange(32) + 0.5) / 16 - 1
        x, y = np.meshgrid(self.half_edge * grid, self.half_edge * grid)
        points = np.array(self.position) + x[..., None] * place[:3, 0] + y[..., None] * place[:3, 1]
        distance = np.linalg.norm(points, axis=-1)
        cosines = points[..., 2] / distance * (points @ -place[:3, 2]) / distance
        irradiance = (cosines / distance**2).mean() * (2 * self.half_edge) ** 2
        return np.pi * self.share / irradiance * self.spectrum


def lamp_spectrum(rng: np.random.Generator) -> tuple[str, np.ndarray]:
    """Its name, and a spectrum at NM of mean 1 over 400 to 700 nm: a blackbody mostly, else a LED or a fluorescent lamp."""
    kind = rng.choice(3, p=(0.75, 0.17, 0.08))
    if kind == 0:
        kelvin = round(rng.uniform(2500, 6500))
        name, curve = f"blackbody {kelvin} K", NM**-5.0 / np.expm1(1.4388e7 / (NM * kelvin))
    elif kind == 1:
        name, curve = "LED", rng.uniform(0.2, 1.1) * bump(rng.uniform(440, 465), 11) + bump(rng.uniform(560, 610), rng.uniform(50, 65))
        curve = curve + 0.01
    else:
        lines = ((405, 0.3), (436, 1.0), (488, 0.4), (545, 1.8), (587, 0.6), (612, 1.5), (708, 0.15), (811, 0.1), (912, 0.15))
        name, curve = "fluorescent", 0.1 + sum(rng.uniform(0.7, 1.3) * height * bump(centre, 7) for centre, height in lines)
        curve = curve * (1 - 0.8 * step(650, 30))
    return name, curve / curve[NM <= 700].mean()


def lamps(rng: np.random.Generator, indoors: bool) -> list[Lamp]:
    """One to four, and some light from everywhere where there is no room; sometimes one more of another colour, which is dim."""
    name, curve = lamp_spectrum(rng)
    shares = rng.dirichlet(np.full(rng.integers(1, 5), 1.5))
    second = rng.random() < 0.3
    even, dim = (0.0 if indoors else rng.uniform(0.05, 0.3)), (rng.uniform(0.05, 0.2) if second else 0.0)
    kinds = [(name, curve, share * (1 - even - dim)) for share in shares]
    if second:
        kinds.append((*lamp_spectrum(rng), dim))
    out: list[Lamp] = []
    for kind, own, share in kinds:
        for _ in range(100):
            azimuth, elevation, distance = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(30, 78)), rng.uniform(0.95, 1.4)
            flat = distance * np.cos(elevation)
            position = (float(flat * np.cos(azimuth)), float(flat * np.sin(azimuth)), float(distance * np.sin(elevation)))
            lamp = Lamp(kind, own, float(share), position, log_uniform(rng, 0.07, 0.32))
            if not any(lamp.hides(other) for other in out):
                break
        out.append(lamp)
    return out if indoors else [*out, Lamp(name, curve, even)]


# ---------------------------------------------------------------------------------------------------------- things


@dataclass(frozen=True)
class Thing:
    """What stands in a scene. ``spectra`` (1 or 2, wavelengths): a paint, two mixed by ``pattern``, or the complex index of a metal."""

    label: str
    surface: Surface
    material: str  # matte, coated or metal
    spectra: np.ndarray
    pattern: np.ndarray | None
    roughness: float
    index: float

    def bsdf(self, mi: Any) -> dict[str, Any]:
        if self.material == "metal":
            eta, k = map(spectrum, self.spectra)
            return {"type": "roughconductor", "eta": eta, "k": k, "alpha": self.roughness, "distribution": "ggx"}
        if self.material == "matte":
            sides = [example.matte(s, NM) for s in self.spectra]
        else:
            sides = [{**example.coated(s, self.roughness, NM), "int_ior": self.index} for s in self.spectra]
        return sides[0] if self.pattern is None else example.blended(mi, self.pattern, *sides)


def stretched(surface: Surface, factors: tuple[float, float, float]) -> Surface:
    normals = surface.normals / np.array(factors)
    length = np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return Surface(surface.vertices * np.array(factors), normals / length, surface.uv, surface.faces)


def standing(surface: Surface) -> Surface:
    return surface.moved((0.0, 0.0, -float(surface.vertices[:, 2].min())))


def lathe(rng: np.random.Generator) -> Surface:
    """A vessel or a turned thing, closed at both ends."""
    height, count = rng.uniform(0.05, 0.15), rng.integers(3, 6)
    radii = rng.uniform(0.012, 0.045, count)
    inner = [(r, h) for r, h in zip(radii, np.linspace(0.08, 0.92, count) * height, strict=True)]
    knots = [(0.0, 0.0), (radii[0] * 0.8, 0.0), *inner, (radii[-1] * 0.7, height), (0.0, height)]
    return example.revolve(example.smooth_profile(knots, 60), 40)


def ring(rng: np.random.Generator) -> Surface:
    tube, radius = rng.uniform(0.009, 0.016), rng.uniform(0.024, 0.034)
    angle = np.linspace(-np.pi / 2, 1.5 * np.pi, 25)
    return example.revolve(np.stack([radius + tube * np.cos(angle), tube * np.sin(angle)], -1), 48)


def rounded_block(rng: np.random.Generator) -> Surface:
    """A superellipsoid, from a box with round edges to an octahedron."""
    power, axes = rng.uniform(1.2, 7), rng.uniform(0.02, 0.042, 3)
    level = lambda p: axes.min() * ((np.abs(p / axes) ** power).sum(-1) ** (1 / power) - 1)
    return example.implicit(level, list(-axes - 0.009), list(axes + 0.009), 0.004)


def blob(rng: np.random.Generator) -> Surface:
    """Balls that melt into each other."""
    centres, radii = rng.uniform(-0.02, 0.02, (4, 3)), rng.uniform(0.012, 0.024, 4)

    def level(points: np.ndarray) -> np.ndarray:
        distances = np.linalg.norm(points[..., None, :] - centres, axis=-1) - radii
        return -0.006 * np.log(np.exp(-distances / 0.006).sum(-1))

    return example.implicit(level, [-0.055] * 3, [0.06] * 3, 0.004)


def wrapped(surface: Surface) -> Surface:
    """With a plan of its front as uv, for surfaces that have none."""
    return replace(surface, uv=surface.vertices[:, [0, 2]] / 0.1)


SHAPES: dict[str, Callable[[np.random.Generator], Surface]] = {
    "sphere": lambda rng: example.ball(rng.uniform(0.02, 0.042)),
    "ellipsoid": lambda rng: example.ellipsoid(tuple(rng.uniform(0.016, 0.045, 3)), 28),
    "box": lambda rng: stretched(example.cube(1.0), tuple(rng.uniform(0.03, 0.08, 3))),
    "lathe": lathe,
    "ring": ring,
    "block": lambda rng: wrapped(rounded_block(rng)),
    "blob": lambda rng: wrapped(blob(rng)),
    "knot": lambda rng: example.trefoil(rng.uniform(0.03, 0.042), rng.uniform(0.007, 0.0125)),
    "vase": lambda rng: stretched(example.vase(), (rng.uniform(0.6, 1.0),) * 2 + (rng.uniform(0.5, 1.0),)),
    "pawn": lambda rng: stretched(example.pawn(), (rng.uniform(0.8, 1.3),) * 3),
    "duck": lambda rng: wrapped(stretched(example.duck_body(), (rng.uniform(0.7, 1.1),) * 3)),
}  # fmt: skip


def pattern(rng: np.random.Generator, size: int = 128) -> np.ndarray:
    """(size, size) weights of the second paint: stripes, checks, dots, spots, or both mixed smoothly."""
    y, x = np.mgrid[0:size, 0:size] / size
    kind, many, few = rng.integers(5), int(rng.integers(3, 9)), int(rng.integers(2, 6))
    if kind == 0:
        mask = np.sin(2 * np.pi * (many * x + rng.integers(-2, 3) * y)) > rng.uniform(-0.6, 0.6)
    elif kind == 1:
        mask = np.sin(2 * np.pi * many * x) * np.sin(2 * np.pi * few * y) > 0
    elif kind == 2:
        mask = np.hypot((many * x) % 1 - 0.5, (many * y) % 1 - 0.5) < rng.uniform(0.2, 0.42)
    else:
        waves = sum(np.cos(2 * np.pi * (a * x + b * y) + rng.uniform(0, 6.3)) for a in range(-4, 5) for b in range(5) if rng.random() < 0.3)
        spots = waves / (np.std(waves) + 1e-9)
        if kind == 4:
            return (1 / (1 + np.exp(-1.5 * spots))).astype(np.float32)
        mask = spots > rng.uniform(-0.5, 0.5)
    return example.soften(mask)


def thing(rng: np.random.Generator, label: str, surface: Surface, material: str, own: np.ndarray | None = None) -> Thing:
    """With random paints, or ``own`` alone."""
    index, two = rng.uniform(1.4, 1.6), rng.random() < 0.45
    if material == "metal":
        return Thing(label, surface, material, np.stack(metal(rng)), None, rng.uniform(0.08, 0.35), index)
    first = paint(rng) if own is None else own
    second = infrared_twin(rng, first) if rng.random() < 0.15 else paint(rng)
    both, where = np.stack([first, second]), pattern(rng)
    roughness = log_uniform(rng, 0.03, 0.3)
    two = two and own is None
    return Thing(label, surface, material, both if two else both[:1], where if two else None, roughness, index)


@dataclass(frozen=True)
class Design:
    """A scene before it is rendered. ``things``: the table first, the room (if any) last."""

    things: list[Thing]
    lamps: list[Lamp]

    def light(self) -> np.ndarray:
        """Radiance at NM of a perfect white that lies flat in the middle of the table, of the lamps alone."""
        return np.sum([lamp.share * lamp.spectrum for lamp in self.lamps], axis=0)

    def labels(self) -> list[str]:
        return ["background", *(t.label for t in self.things)]


def free_place(rng: np.random.Generator, taken: list[tuple[float, float, float]], radius: float) -> tuple[float, float] | None:
    """Where on the table a thing of this radius fits beside others (x, y, radius) [m], if it does."""
    for _ in range(200):
        distance = np.sqrt(rng.random()) * (TABLE_RADIUS - 0.012 - radius)
        angle = rng.uniform(0, 2 * np.pi)
        x, y = distance * np.cos(angle), distance * np.sin(angle)
        if all(np.hypot(x - a, y - b) > radius + r + 0.004 for a, b, r in taken):
            return x, y
    return None


def design(seed: int, index: int) -> Design:
    """Scene ``index`` of ``seed``."""
    rng = np.random.default_rng([seed, index])
    indoors = rng.random() < 0.4
    light = lamps(rng, indoors)
    out = Design([thing(rng, "table", example.table_top(TABLE_RADIUS, 0.02), str(rng.choice(["matte", "coated"], p=(0.7, 0.3))))], light)
    materials = ["coated", "matte", "metal", *rng.choice(["coated", "matte", "metal"], rng.integers(2, 6), p=(0.55, 0.3, 0.15))]
    # a pair of things: the same to the colour camera, or in all of the visible
    pair: list[np.ndarray | None] = [None, None]
    if rng.random() < 0.6:
        first = paint(rng)
        weights = responses()["rgb"] * out.light()
        pair = [first, metamer(rng, first, weights) if rng.random() < 0.5 else infrared_twin(rng, first)]
        materials[1] = "coated"
    taken: list[tuple[float, float, float]] = []
    for number, material in enumerate(materials):
        shape = str(rng.choice(list(SHAPES)))
        made = standing(SHAPES[shape](rng))
        radius = float(np.linalg.norm(made.vertices[:, :2], axis=-1).max())
        place = free_place(rng, taken, radius)
        if place is None:  # a ball of a marble's size fits anywhere
            shape, radius = "sphere", 0.018
            made, place = standing(example.ball(radius)), free_place(rng, taken, radius)
        if place is None:
            continue
        taken.append((*place, radius))
        surface = made.moved((*place, 0.0), rng.uniform(0, 360))
        own = pair[number] if number < 2 else None
        out.things.append(thing(rng, f"{material} {shape} {number}", surface, str(material), own))
    if indoors:
        walls = stretched(example.cube(1.0), (*(2 * rng.uniform(1.5, 2.2, 2)), rng.uniform(2.3, 2.9))).moved((0.0, 0.0, -0.75))
        inside = Surface(walls.vertices, -walls.normals, walls.uv, np.ascontiguousarray(walls.faces[:, ::-1]))
        colour = np.clip(0.35 + 0.55 * paint(rng), DARKEST, BRIGHTEST)
        out.things.append(Thing("room", inside, "matte", colour[None], None, 0.1, 1.5))
    return out


# --------------------------------------------------------------------------------------------------------- sensors


@functools.cache
def responses() -> dict[str, np.ndarray]:
    """(C, wavelengths) by modality, at NM, of the packaged sensors; one row for polarization, whose photosites share it."""
    out: dict[str, np.ndarray] = {}
    for name in ("rgb", "infrared", "mono", "polarization", "multispectral"):
        curves = [c.response for c in load_sensor(find_sensor_file(f"mmsdata_{name}")).channels]
        known = [curve.at(NM) if curve else out["infrared"][0] for curve in curves]
        out[name] = np.stack(known[:1] if name == "polarization" else known)
    return out


def rig(scale: float) -> list[RigSensor]:
    """The sensors of the example scene, with packaged responses; ``scale``: of their pictures."""
    out = []
    for sensor in example.rig():
        c = sensor.camera
        centre = (scale * (c.cx + 0.5) - 0.5, scale * (c.cy + 0.5) - 0.5)
        camera = Camera(round(scale * c.width), round(scale * c.height), scale * c.fx, scale * c.fy, *centre, c.distortion)
        out.append(replace(sensor, camera=camera, responses=responses()[sensor.name]))
    return out


def rig_poses(rng: np.random.Generator) -> list[np.ndarray]:
    """RGB camera-to-scene poses [m] around the table."""
    poses, start = [], rng.uniform(0, 360)
    for view in range(VIEWS):
        azimuth, elevation = np.radians(start + 360 / VIEWS * view + rng.uniform(-15, 15)), np.radians(rng.uniform(18, 60))
        target = np.array([0.0, 0.0, 0.03]) + rng.uniform(-0.02, 0.02, 3)
        direction = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        poses.append(example.look_at(target + rng.uniform(0.55, 0.75) * direction, target, rng.uniform(-6, 6)))
    return poses


def integrals(radiance: np.ndarray) -> dict[str, np.ndarray]:
    """Radiance at NM → integral of radiance × response over nm, (C,) by modality."""
    return {name: np.trapezoid(curves * radiance, NM, axis=-1) for name, curves in responses().items()}


def gain_of(sensor: RigSensor, images: np.ndarray) -> float:
    """Of a modality's pictures (..., C) or Stokes vectors (..., 3): the bright photosites come to the exposure that is aimed at."""
    bright = (images[..., 0] + np.hypot(images[..., 1], images[..., 2])) / 2 if sensor.polarized else images
    return float(f"{example.EXPOSURE_TARGET / np.percentile(bright, 99.5):.6g}")


def describe(made: Design, sensors: list[RigSensor], gains: dict[str, float], noise: dict[str, float]) -> dict[str, Any]:
    """sensors.json. ``noise``: median relative standard error of the truth, by modality."""
    white = integrals(made.light())
    lit = [{"kind": lamp.kind, "share": round(lamp.share, 6), "position_m": lamp.position and example.rounded(np.array(lamp.position)),
            "half_edge_m": round(lamp.half_edge, 6), "spectrum": np.round(lamp.spectrum, 6).tolist()} for lamp in made.lamps]  # fmt: skip
    entries = {
        s.name: {
            "gain": gains[s.name],
            "white": np.round(gains[s.name] * white[s.name], 6).tolist(),
            "response": np.round(s.responses, 6).tolist(),
            "bits": s.bits,
            "noise_of_truth": round(noise[s.name], 5),
        }
        for s in sensors
    }
    raw = {"full_well_electrons": example.FULL_WELL, "read_noise_electrons": example.READ_NOISE}
    return {"wavelengths_nm": NM.tolist(), "light": np.round(made.light(), 6).tolist(), "lamps": lit, **raw, "sensors": entries}


# ------------------------------------------------------------------------------------------------------- rendering


def build_scene(mi: Any, made: Design) -> tuple[Any, list[tuple[Any, int]]]:
    """Mitsuba scene and (shape, label) pairs."""
    content: dict[str, Any] = {}
    for i, lamp in reversed(list(enumerate(made.lamps))):  # the light from everywhere first
        emitter: dict[str, Any] = {"type": "constant" if lamp.position is None else "area", "radiance": spectrum(lamp.radiance())}
        emitter["sampling_weight"] = lamp.share
        if lamp.position is None:
            content[f"lamp{i}"] = emitter
            continue
        place = mi.ScalarTransform4f().look_at(origin=list(lamp.position), target=[0.0, 0.0, 0.0], up=[0.0, 0.0, 1.0])
        place = place @ mi.ScalarTransform4f().scale([lamp.half_edge, lamp.half_edge, 1.0])
        content[f"lamp{i}"] = {"type": "rectangle", "to_world": place, "emitter": emitter}
    for i, t in enumerate(made.things):
        content[f"part{i}"] = example.to_mitsuba(mi, f"part{i}", t.surface, t.bsdf(mi))
    scene = example.load_scene(mi, content)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    return scene, [(shapes[f"part{i}"], i + 1) for i in range(len(made.things))]


def render_all(mi: Any, scene: Any, camera: Camera, pose: np.ndarray, light: np.ndarray, spp: int, seed: int) -> dict[str, np.ndarray]:
    """Integrals of radiance × response over nm, (H, W, C) by modality; Stokes vectors for polarization.

    All channels of a pixel are summed over the same paths: a comb of wavelengths (its teeth 37.5 nm apart, which integrates a band of 40 nm
    to a few percent at any shift, without bias over shifts) is traced in passes that repeat the paths.
    """
    import drjit as dr

    curves = responses()
    table = np.concatenate([*curves.values(), CLAMP * light[None]])
    # past the last wavelength nothing is measured; one entry more for the interpolation
    entries = [mi.Float(np.append(row, 0.0)) for row in table]
    spacing = (NM[-1] - NM[0]) / TEETH
    pol = list(curves).index("polarization")
    rows = np.repeat(np.arange(len(curves)), [len(c) for c in curves.values()])
    total: Any = 0.0
    for first in range(TEETH // 4):
        start = dr.opaque(mi.Float, float(NM[0] + first * spacing))

        def comb(_: Any, shift: Any, start: Any = start) -> list[Any]:
            return [start + (shift + k * (TEETH // 4)) * spacing for k in range(4)]

        for nm, mueller in example.trace(mi, scene, camera, pose, spp, seed, comb):
            sums = [mi.Float(0.0)] * (len(rows) + 2)
            for k in range(4):
                place = (nm[k] - NM[0]) / (NM[1] - NM[0])
                cell = dr.minimum(mi.UInt32(place), len(NM) - 1)
                part = place - mi.Float(cell)
                *sensitivity, limit = [dr.lerp(dr.gather(mi.Float, e, cell), dr.gather(mi.Float, e, cell + 1), part) for e in entries]
                stokes = [mueller[i, 0][k] for i in range(3)]
                shrink = dr.minimum(1.0, limit / dr.maximum(stokes[0], 1e-20))
                for c, response in enumerate(sensitivity):
                    sums[c] = sums[c] + response * shrink * stokes[0]
                    if rows[c] == pol:
                        for i in (1, 2):
                            sums[len(rows) + i - 1] = sums[len(rows) + i - 1] + response * shrink * stokes[i]
            total = total + example.photosite_sums(sums, camera)
    image = (total * spacing / spp).reshape(camera.height, camera.width, -1)
    stokes_rows = [np.flatnonzero(rows == pol)[0], len(rows), len(rows) + 1]
    return {name: image[..., stokes_rows if i == pol else np.flatnonzero(rows == i)] for i, name in enumerate(curves)}


def raw_frame(mi: Any, scene: Any, sensor: RigSensor, pose: np.ndarray, clamp: float, seed: int) -> np.ndarray:
    """Integral of radiance × response over nm at each photosite (H, W)."""
    table = example.wavelength_table(sensor.responses, NM)
    own = example.own_channels(sensor)
    stokes = example.render(mi, scene, sensor.camera, pose @ sensor.to_reference, table, own, RAW_SPP, seed, clamp)
    return example.photosites(sensor, stokes) * np.trapezoid(sensor.responses, NM, axis=-1)[own]


def render_scene(
    mi: Any, made: Design, sensors: list[RigSensor], poses: list[np.ndarray], spp: int, seed: int, out: Path
) -> dict[str, float]:
    """Renders a scene into a folder and returns the noise of its truth, see `describe`."""
    import cv2

    scene, labelled = build_scene(mi, made)
    camera, light = sensors[0].camera, made.light()
    geometry = [example.first_hit(mi, scene, labelled, camera, pose) for pose in poses]
    # two halves: their difference is the noise
    halves = [
        [render_all(mi, scene, camera, pose, light, spp, own + view) for view, pose in enumerate(poses)] for own in (seed, seed + 100)
    ]
    one, two = ({s.name: np.stack([view[s.name] for view in half]) for s in sensors} for half in halves)
    truth = {name: (one[name] + two[name]) / 2 for name in one}
    gains = {s.name: gain_of(s, truth[s.name]) for s in sensors}
    noise = {}
    region = np.stack([g["in_roi"] for g in geometry])
    for s in sensors:
        first, second = (half[s.name][region][:, : 1 if s.polarized else None] for half in (one, two))
        relative = np.abs(first - second) / np.maximum(first + second, 1e-9)
        noise[s.name] = float(1.4826 * np.median(relative))

    points = np.concatenate([t.surface.vertices for t in made.things if t.label != "room"])
    points = (points - example.WORLD_OFFSET) / example.WORLD_SCALE
    meta = {**example.meta_data(sensors, poses, points.min(0), points.max(0)), "test_ids": list(TEST_VIEWS)}
    calibration = {s.name: {"sensor": s.title, **example.lens(s), "camera2reference": example.rounded(s.to_reference)} for s in sensors}
    example.write_json(out / "meta_data.json", meta)
    example.write_json(out / "calibration.json", calibration)
    described = describe(made, sensors, gains, noise)
    whites = {name: of["white"] for name, of in described["sensors"].items()}
    example.write_json(out / "exposure.json", {**gains, "white": whites})
    example.write_json(out / "sensors.json", described)
    example.write_json(out / "gt/labels.json", {str(i): name for i, name in enumerate(made.labels())})
    for view, pose in enumerate(poses):
        aligned = {s.name: (gains[s.name] * truth[s.name][view]).astype(np.float16) for s in sensors}
        example.write_npz(out / f"gt/aligned/{view:04d}.npz", **aligned, spp=np.int64(2 * spp))
        example.write_npz(out / f"gt/geometry/{view:04d}.npz", **geometry[view])
        for number, s in enumerate(sensors):
            own = seed + 1000 * (number + 1) + view
            raw = gains[s.name] * raw_frame(mi, scene, s, pose, CLAMP * float(light.max()), own)
            path = out / "modalities" / s.name / f"{view:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), example.measure(raw, s.bits, np.random.default_rng(own)), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return noise


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scale", type=float, default=2 / 3, help="of the example scene's pictures (rgb 96x72)")
    parser.add_argument("--spp", type=int, default=100, help="samples per pixel of each half of the truth, a square number")
    parser.add_argument("--variant", default="llvm_ad_spectral_polarized")
    parser.add_argument("--threads", type=int, default=0, help="0: all cores")
    arguments = parser.parse_args()
    mi = example.load_mitsuba(arguments.variant)
    if arguments.threads:
        import drjit

        drjit.set_thread_count(arguments.threads)
    sensors = rig(arguments.scale)
    for index in range(arguments.scenes):
        out = arguments.out / f"{arguments.seed}_{index:04d}"
        if out.is_dir():
            print(f"{out}: there", flush=True)
            continue
        began = time.perf_counter()
        made = design(arguments.seed, index)
        poses = rig_poses(np.random.default_rng([arguments.seed, index, 1]))
        unfinished = out.with_suffix(".part")
        shutil.rmtree(unfinished, ignore_errors=True)
        noise = render_scene(mi, made, sensors, poses, arguments.spp, 10000 * (index + 1), unfinished)
        os.replace(unfinished, out)
        lit = ", ".join(sorted({lamp.kind for lamp in made.lamps}))
        worst = max(noise.values())
        print(f"{out}: {len(made.things)} things, {lit}; noise {100 * worst:.1f} %; {time.perf_counter() - began:.1f} s", flush=True)


if __name__ == "__main__":
    main()
