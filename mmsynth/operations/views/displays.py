"""What of a field can be looked at, by name, and its pictures.

rgb, ms                   all channels of a modality, as a display's colours
ms:5, ms:530nm, rgb:R     one channel, counted from 0 or by its label, in grey
550nm                     the light at a wavelength, between the bands around it
ms:7/nir:0/ms:1           three channels as red, green and blue
s0, dolp, aolp, pol:aolp  of a polarization modality
depth, normals, opacity   of the surface
coverage                  how well the training frames saw what is shown
diffuse, specular         rgb:specular: a modality without the images of lamps, and these alone
rgb:deviation             standard deviation of a predicted modality, mean over its channels, five times as bright
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from mmsynth.errors import InputError
from mmsynth.operations.output import previews
from mmsynth.scene.preview_colours import PreviewColours
from mmsynth.scene.scene import PosedCamera, Sensor, canonical_modality
from mmsynth.sensors.camera import ray_map

if TYPE_CHECKING:
    from mmsynth.field.field import Field

Kind = Literal[
    "colours", "channels", "s0", "dolp", "aolp", "depth", "normals", "opacity", "coverage", "diffuse", "specular", "deviation"
]  # fmt: skip
_OF_POLARIZATION = ("s0", "dolp", "aolp")
_OF_SURFACE = ("depth", "normals", "opacity", "coverage")
_OF_LIGHT = ("diffuse", "specular")
_DEVIATION = 5.0  # times as bright

Seen = Mapping[str, np.ndarray]
"""What a camera sees, (H, W, ...) by the keys of ``Field.render_rays``, float32: depth and normals are NaN where nothing is met, and all
of a pixel is where the lens has no ray; ``coverage`` where somebody added it."""


@dataclass(frozen=True)
class Display:
    """One thing to look at.

    Attributes:
        name: see the module docstring. modality: whose, None of surfaces.
        channels: of "channels": red, green, blue, or one for grey; each a sum of (modality, channel, weight).
    """

    name: str
    kind: Kind
    modality: str | None = None
    channels: tuple[tuple[tuple[str, int, float], ...], ...] = ()

    @property
    def modalities(self) -> tuple[str, ...]:
        """That have to be rendered for it."""
        of_channels = dict.fromkeys(name for mix in self.channels for name, _, _ in mix)
        return tuple(of_channels) if self.modality is None else (self.modality,)

    @property
    def needs_normals(self) -> bool:
        return self.kind in ("normals", "coverage")

    @property
    def needs_light(self) -> bool:
        return self.kind in _OF_LIGHT


def displays_of(field: Field) -> list[Display]:
    """All but mixtures of channels: every modality, its channels, polarization, light, deviation, then the surface."""
    found = []
    for name, sensor in field.sensors.items():
        found.append(Display(name, "colours", name))
        if sensor.is_polarization:
            found += [Display(f"{name}:{kind}", kind, name) for kind in ("s0", "dolp", "aolp")]
        if sensor.channel_count > 1:
            found += [Display(f"{name}:{label}", "channels", None, (((name, i, 1.0),),)) for i, label in enumerate(sensor.channels)]
        if field.shines:
            found += [Display(f"{name}:{kind}", kind, name) for kind in ("diffuse", "specular")]
        if name in field.predicted:
            found.append(Display(f"{name}:deviation", "deviation", name))
    return found + [Display(kind, kind) for kind in ("depth", "normals", "opacity", "coverage")]


def find_display(field: Field, text: str) -> Display:
    """The display of a name.

    Raises:
        InputError: the field has no such modality, channel, polarization, lamps or bands around that wavelength.
    """
    text = text.strip()
    if text.count("/") == 2:
        return Display(text, "channels", None, tuple(_channel(field, part) for part in text.split("/")))
    if re.fullmatch(r"\d+(\.\d+)?\s*nm", text):
        return Display(text, "channels", None, (_at_wavelength(field, float(text.removesuffix("nm"))),))
    modality, _, what = text.partition(":")
    if text in _OF_SURFACE:
        return Display(text, text)  # type: ignore[arg-type]
    if text in _OF_LIGHT:
        modality, what = next(iter(field.sensors)), text
    if text in _OF_POLARIZATION:
        of = [name for name, sensor in field.sensors.items() if sensor.is_polarization]
        if not of:
            raise InputError(f"{text}: the field has no polarization modality; it has {', '.join(field.sensors)}.")
        modality, what = of[0], text
    modality = canonical_modality(modality)
    sensor = _sensor(field, modality, text)
    name = f"{modality}:{what}" if what else modality
    if not what:
        return Display(name, "colours", modality)
    if what in _OF_POLARIZATION:
        if not sensor.is_polarization:
            raise InputError(f"{text}: {modality} is no polarization modality.")
        return Display(name, what, modality)  # type: ignore[arg-type]
    if what in _OF_LIGHT:
        if not field.shines:
            raise InputError(f"{text}: no surface of this field mirrors lamps.")
        return Display(name, what, modality)  # type: ignore[arg-type]
    if what == "deviation":
        if modality not in field.predicted:
            raise InputError(f"{text}: {modality} was measured, expected a predicted modality.")
        return Display(name, "deviation", modality)
    return Display(name, "channels", None, (_channel(field, text),))


def label_of(field: Field, display: Display) -> str:
    """A display's name for people: what a prior predicts has a star."""
    return f"{display.name} *" if set(display.modalities) & set(field.predicted) else display.name


def at_wavelength(field: Field, nm: float) -> Display:
    """The light at a wavelength. Raises InputError: there are no bands on both sides of it."""
    return Display(f"{nm:g}nm", "channels", None, (_at_wavelength(field, nm),))


def bands_of(field: Field) -> list[tuple[float, str, int]]:
    """(wavelength [nm], modality, channel) of every channel with a wavelength, in their order."""
    return sorted((nm, name, i) for name, sensor in field.sensors.items() for i, nm in enumerate(sensor.wavelengths_nm) if nm is not None)


def channel_names(field: Field) -> list[str]:
    """Names of single channels, of polarization none."""
    of = {name: sensor for name, sensor in field.sensors.items() if not sensor.is_polarization}
    return [f"{name}:{label}" for name, sensor in of.items() for label in sensor.channels]


def _sensor(field: Field, modality: str, text: str) -> Sensor:
    if modality not in field.sensors:
        known = [*field.sensors, *_OF_SURFACE]
        if any(sensor.is_polarization for sensor in field.sensors.values()):
            known += _OF_POLARIZATION
        raise InputError(f"{text!r}: nothing of this field, expected some of {', '.join(known)}, or a channel such as {_example(field)}.")
    return field.sensors[modality]


def _example(field: Field) -> str:
    name, sensor = next(iter(field.sensors.items()))
    return f"{name}:{sensor.channels[0]}"


def _channel(field: Field, text: str) -> tuple[tuple[str, int, float], ...]:
    modality, _, label = text.strip().partition(":")
    modality = canonical_modality(modality)
    labels = _sensor(field, modality, text).channels
    index = labels.index(label) if label in labels else int(label) if label.isdecimal() else 0 if not label and len(labels) == 1 else -1
    if not 0 <= index < len(labels):
        raise InputError(f"{text!r}: no such channel, expected one of {', '.join(labels)}, or its number from 0 to {len(labels) - 1}.")
    return ((modality, index, 1.0),)


def _at_wavelength(field: Field, nm: float) -> tuple[tuple[str, int, float], ...]:
    """Linear between the two bands around it of the modality that has the most bands there."""
    best: list[tuple[float, str, int]] = []
    for name in field.sensors:
        own = [band for band in bands_of(field) if band[1] == name]
        if own and own[0][0] <= nm <= own[-1][0] and len(own) > len(best):
            best = own
    if not best:
        known = [band[0] for band in bands_of(field)]
        span = f"{known[0]:g} to {known[-1]:g} nm" if known else "none with a wavelength"
        raise InputError(f"{nm:g}nm: no bands of one modality around it; the field's channels: {span}.")
    upper = next(i for i, band in enumerate(best) if band[0] >= nm)
    lower = max(0, upper - (best[upper][0] > nm))
    if lower == upper:
        return ((best[upper][1], best[upper][2], 1.0),)
    share = (nm - best[lower][0]) / (best[upper][0] - best[lower][0])
    return tuple((best[i][1], best[i][2], weight) for i, weight in ((lower, 1.0 - share), (upper, share)))


# ------------------------------------------------------------------------------------------------------------------------ pictures


def look(field: Field, view: PosedCamera, displays: Iterable[Display], go_on: Callable[[], bool] = lambda: True) -> Seen | None:
    """What a camera sees of all that displays need.

    Args:
        go_on: asked after every tile of rays.
    Returns:
        None where ``go_on`` said no.
    """
    wanted = list(displays)
    names = list(dict.fromkeys(name for display in wanted for name in display.modalities))
    normals, light = any(d.needs_normals for d in wanted), any(d.needs_light for d in wanted)
    in_camera, valid = ray_map(view.camera)
    rows = np.flatnonzero(valid)
    directions = in_camera.reshape(-1, 3)[rows]
    found: dict[str, np.ndarray] = {}
    for part, seen in field.cast_tiles([(rows, directions)], view.camera_to_world, names, normals, light):
        for key, value in seen.items():
            if key not in found:
                found[key] = np.full((valid.size, *value.shape[1:]), np.nan, np.float32)
            found[key][part] = value
        if not go_on():
            return None
    out = {key: value.reshape(*valid.shape, *value.shape[1:]) for key, value in found.items()}
    if "depth" in out:
        out["depth_z"] = (out["depth"] * in_camera[..., 2]).astype(np.float32)
    return out


def linear_of(field: Field, display: Display, seen: Seen, colours: Mapping[str, PreviewColours] | None = None) -> np.ndarray:
    """(H, W, 3) linear light of a display of light, not yet exposed."""
    if display.kind == "channels":
        mixes = [sum(weight * seen[name][..., index] for name, index, weight in mix) for mix in display.channels]
        return np.nan_to_num(np.stack([np.asarray(m) for m in (mixes if len(mixes) == 3 else mixes * 3)], -1))
    name = display.modality
    assert name is not None
    if display.kind == "s0":
        return np.nan_to_num(np.repeat(seen[f"stokes/{name}"][..., :1], 3, -1))
    if display.kind == "deviation":
        return np.nan_to_num(np.repeat(_DEVIATION * seen[f"deviation/{name}"].mean(-1, keepdims=True), 3, -1))
    light = {
        "colours": lambda: seen[name],
        "specular": lambda: seen[f"mirrored/{name}"],
        "diffuse": lambda: seen[name] - seen[f"mirrored/{name}"],
    }[display.kind]()
    return previews.preview_linear(field.sensors[name], light, (colours or {}).get(name))


def is_light(display: Display) -> bool:
    """Whether exposure matters."""
    return display.kind in ("colours", "channels", "s0", "diffuse", "specular", "deviation")


def picture(
    field: Field,
    display: Display,
    seen: Seen,
    exposure: float = 1.0,
    tone: float = 1.0,
    colours: Mapping[str, PreviewColours] | None = None,
    depth_range: tuple[float, float] | None = None,
) -> np.ndarray:
    """(H, W, 3) uint8 of what ``look`` found.

    Args:
        exposure: factor of light, and of DoLP. tone: exponent of what the display shows of light, below 1 dark parts are brighter.
        colours: of modalities, None: as channels are. depth_range: nearest and farthest [radii], None: those of the picture.
    """
    if is_light(display):
        shown = previews.tone_map(linear_of(field, display, seen, colours), exposure)
        return previews.to_uint8(shown if tone == 1.0 else shown**tone)
    if display.kind == "dolp":
        return previews.as_rgb(previews.to_uint8(exposure * previews.preview_dolp(seen[f"stokes/{display.modality}"])))
    if display.kind == "aolp":
        return previews.to_uint8(previews.preview_aolp(seen[f"stokes/{display.modality}"], exposure))
    if display.kind == "depth":
        return previews.preview_depth(seen["depth"], depth_range)
    if display.kind == "normals":
        return previews.preview_normal(seen["normal"])
    if display.kind == "coverage":
        return previews.preview_share(seen["coverage"])
    return previews.as_rgb(np.nan_to_num(seen["opacity"]))


def exposures_of(
    field: Field, displays: Sequence[Display], seen: Seen, colours: Mapping[str, PreviewColours] | None = None
) -> dict[str, float]:
    """By modality, the exposure under which what is seen of it is well lit; mixtures of several have one of their own, by name."""
    out: dict[str, float] = {}
    for display in displays:
        if is_light(display):
            out.setdefault(exposure_key(display), previews.exposure_of(linear_of(field, _whole(display), seen, colours)))
    return out


def exposure_key(display: Display) -> str:
    """Displays of one modality, its parts too, are exposed alike."""
    return display.modalities[0] if len(display.modalities) == 1 else display.name


def _whole(display: Display) -> Display:
    name = display.modalities[0]
    return display if len(display.modalities) > 1 else Display(name, "colours", name)
