"""Options that several commands have, and the texts of options read into values."""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from mmsynth.errors import InputError

if TYPE_CHECKING:
    from mmsynth.scene.scene import MaskMeaning

ResultsOption = Annotated[Path, typer.Option(help="what is there already is not made again, and a fit that was interrupted goes on")]
RunOption = Annotated[Path | None, typer.Option("--run", help="run folder; default: the last fit made in this folder")]
DeviceOption = Annotated[str, typer.Option(help="auto, cpu or cuda")]
JsonOption = Annotated[bool, typer.Option("--json", help="print one JSON object on stdout and nothing else there")]
SceneArgument = Annotated[str, typer.Argument(metavar="SCENE", help="scene folder, or `example` for the packaged scene")]
RecipeOption = Annotated[str | None, typer.Option(help="packaged recipe or TOML file")]
ModalitiesOption = Annotated[str | None, typer.Option(help="fit these only, e.g. rgb,ms")]
LayoutOption = Annotated[
    str | None, typer.Option(help="MMS-DATA, nerfstudio, Blender, COLMAP, NeuS or Middlebury; default: the one that the folder holds")
]
ImagesOption = Annotated[Path | None, typer.Option(help="folder where the pictures are; default: where the scene's files say")]
AlsoOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=FOLDER[:calibration.json]",
        help="one more sensor, pictures of the same names in another folder, with its own camera and place or those of the first sensor",
    ),
]
FramesOption = Annotated[
    str | None, typer.Option(help="number of training frames to keep of some modalities, e.g. pol=3,ms=5; default: all")
]

MasksOption = Annotated[
    list[str] | None,
    typer.Option(
        "--masks",
        metavar="object|ignore|off|FOLDER",
        help="what masks mean: nothing is outside, do not learn from what is outside, or they only score; "
        "or a folder of masks, such as MMS-DATA's archive; may be given twice, once for each",
    ),
]


def modality_names(text: str | None) -> list[str] | None:
    from mmsynth.scene.scene import canonical_modality

    return None if text is None else [canonical_modality(n) for n in text.split(",") if n.strip()]


def view_ids(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    if not re.fullmatch(r"\d+(,\d+)*", text):
        raise InputError(f"--views {text!r}: expected view ids such as 9,19.")
    return tuple(int(v) for v in text.split(","))


def frame_limits(text: str | None) -> dict[str, int]:
    from mmsynth.scene.scene import canonical_modality

    limits: dict[str, int] = {}
    for part in text.split(",") if text is not None else ():
        match = re.fullmatch(r"\s*([^=\s]+)\s*=\s*(\d+)\s*", part)
        name = canonical_modality(match[1]) if match else ""
        if not match or name in limits:
            raise InputError(f"--frames {text!r}: expected a number of frames per modality, each once, such as pol=3,ms=5.")
        limits[name] = int(match[2])
    return limits


def sensor_folders(given: list[str] | None) -> dict[str, str]:
    found: dict[str, str] = {}
    for text in given or ():
        name, equals, folder = text.partition("=")
        if not equals or not name.strip() or not folder.strip() or name.strip() in found:
            raise InputError(f"--also {text!r}: expected a sensor and a folder, each sensor once, such as nir=FOLDER.")
        found[name.strip()] = folder.strip()
    return found


def modality_pairs(text: str, sources: list[str], targets: list[str]) -> list[tuple[str, str]]:
    from mmsynth.scene.scene import canonical_modality

    if text == "all":
        return [(a, b) for a in sources for b in targets if a != b]
    if not re.fullmatch(r"[^:,\s]+:[^:,\s]+(,[^:,\s]+:[^:,\s]+)*", text):
        raise InputError(f"--convert {text!r}: expected pairs such as rgb:ms or rgb:ms,mono:pol, or all.")
    pairs = [part.split(":") for part in text.split(",")]
    return [(canonical_modality(a), canonical_modality(b)) for a, b in pairs]


def whole_numbers(text: str, option: str, example: str = "0,1") -> list[int]:
    """Whole numbers joined by commas."""
    if not re.fullmatch(r"\d+(,\d+)*", text):
        raise InputError(f"{option} {text!r}: expected numbers such as {example}.")
    return [int(number) for number in text.split(",")]


def fractions(text: str, option: str) -> list[Fraction]:
    """Shares joined by commas."""
    try:
        return [Fraction(part) for part in text.split(",")]
    except (ValueError, ZeroDivisionError) as error:
        raise InputError(f"{option} {text!r}: expected shares such as 1/8,1/2,1.") from error


def lengths(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or not all(0 < x < float("inf") for x in found):
        raise InputError(f"--distances {text!r}: expected lengths above 0 such as 0.001,0.002.")
    return found


def seconds_of(text: str, option: str = "--budget") -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|m|h)?", text.strip())
    if not match or float(match[1]) <= 0:
        raise InputError(f"{option} {text!r}: expected a time such as 60s, 5m or 1h.")
    return float(match[1]) * {"s": 1, "m": 60, "h": 3600}[match[2] or "s"]


def masks_of(texts: list[str] | None) -> tuple[MaskMeaning | None, Path | None]:
    """What masks mean, and the folder that they lie in."""
    meanings = [text for text in texts or () if text in ("object", "ignore", "off")]
    folders = [Path(text) for text in texts or () if text not in ("object", "ignore", "off")]
    if len(meanings) > 1 or len(folders) > 1:
        raise InputError(f"--masks {' --masks '.join(texts or ())}: expected one of object, ignore, off, and one folder.")
    if folders and not folders[0].is_dir():
        raise InputError(f"--masks {folders[0]}: no such folder, expected one of masks, or object, ignore or off.")
    return (cast("MaskMeaning", meanings[0]) if meanings else None), (folders[0] if folders else None)


def fit_length(steps: int | None, budget: str | None, default: str | None = None) -> float | None:
    """Seconds of a fit whose length is not given in steps."""
    if steps is not None and budget is not None:
        raise InputError("--steps and --budget: give one of the two.")
    text = budget or default
    return seconds_of(text) if text and steps is None else None


def scene_path(text: str) -> Path:
    from mmsynth.packaged import data_folder

    path = Path(text)
    return data_folder("example_scene") if text == "example" and not path.exists() else path
