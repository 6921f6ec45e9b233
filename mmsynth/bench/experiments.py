"""The field's experiments as data: TOML files of rows (``recipes/paper``), and which fits of a scene each row asks for.

    title = "Few frames"
    source = "paper that has this table"
    note = "a sentence for those who read it"

    [[row]]
    name = "rgb + 3 frames"
    modalities = ["rgb", "scored"]       # fitted; left out: all
    frames = { scored = 3 }              # training frames, a number or a share of them; left out: all
    rays = 0.5                           # share of the rays of a step
    input = "demosaicked"                # and undistorted; left out: raw frames
    prior = true                         # tells what is not fitted; such rows are for those who give one

A table has a column for each modality. ``scored`` is the modality of the column, so that such a row asks for a fit for each; ``all`` are
all modalities of the scene; ``each``, which is for names, too (``{each}``), repeats the row with every modality. In ``frames`` what is said
of one modality wins over what is said of ``all``, and 1.0 is all of its frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from mmsynth.bench.jobs import Input
from mmsynth.errors import InputError
from mmsynth.fitting.recipe import Recipe, recipe_path
from mmsynth.operations.export.demosaicked import is_plain
from mmsynth.packaged import data_folder
from mmsynth.scene.scene import Scene, canonical_modality
from mmsynth.toml import read_toml

PACKAGED = ("together", "pairs", "half", "unbalanced", "mosaics", "rgb-only", "few-frames")
"""Tables of ``recipes/paper``, in the order in which they are made."""
Count = Annotated[int, Field(strict=True, ge=1)]
Share = Annotated[float, Field(strict=True, gt=0, le=1)]


class Row(BaseModel):
    """One line of a table; see the module docstring."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(min_length=1)
    modalities: list[str] = Field(["all"], min_length=1)
    frames: dict[str, Count | Share] = {}
    rays: float = Field(1.0, gt=0, le=1)
    input: Input = "raw"
    prior: bool = False

    @model_validator(mode="after")
    def _says_what_it_repeats(self) -> Row:
        if ("{each}" in self.name) != ("each" in {*self.modalities, *self.frames}):
            raise ValueError("'each' stands in the name, as {each}, and in modalities or frames, or in neither")
        return self

    def repeated(self, modalities: Sequence[str]) -> list[Row]:
        """The row with every modality in place of ``each``, or itself."""
        if "{each}" not in self.name:
            return [self]
        put = lambda word, name: name if word == "each" else word
        return [
            self.model_copy(
                update={
                    "name": self.name.replace("{each}", name),
                    "modalities": [put(word, name) for word in self.modalities],
                    "frames": {put(word, name): limit for word, limit in self.frames.items()},
                }
            )
            for name in modalities
        ]


class Experiment(BaseModel):
    """One table."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str
    source: str
    note: str = ""
    row: list[Row] = Field(min_length=1)

    @model_validator(mode="after")
    def _has_each_row_once(self) -> Experiment:
        names = [row.name for row in self.row]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"row {name!r} is there twice, expected one of each name")
        return self


@dataclass(frozen=True)
class Fit:
    """What a cell of a table is the score of, on one scene.

    Attributes:
        modalities: in the scene's order. frames: modality → training frames, of those that keep fewer than all. rays: share of those of
            a step. prior: whether one tells what is not fitted.
    """

    modalities: tuple[str, ...]
    frames: tuple[tuple[str, int], ...]
    rays: float
    input: Input
    prior: bool = False

    @property
    def name(self) -> str:
        """For names of files, the same for the same fit."""
        frames = dict(self.frames)
        parts = ["+".join(f"{m}{frames.get(m, '')}" for m in self.modalities)]
        of_rays = [f"rays{self.rays:g}"] if self.rays < 1 else []
        return "-".join([*parts, *of_rays, *(["demosaicked"] if self.input != "raw" else []), *(["prior"] if self.prior else [])])

    def recipe(self, recipe: Recipe, known: int | None) -> Recipe:
        """The recipe with this fit's rays of a step.

        Args:
            known: number of the scene's modalities, where each is to have the same number of rays in every fit; None: a fit of fewer
                modalities has as many rays as one of all.
        """
        share = self.rays * (1.0 if known is None else len(self.modalities) / known)
        if share == 1.0:
            return recipe
        sampling = recipe.sampling
        return recipe.with_changes({
            "sampling.samples_per_step": max(256, round(sampling.samples_per_step * share)),
            "sampling.initial_rays": max(1, round(sampling.initial_rays * share)),
        })  # fmt: skip


def load_experiments(names: Sequence[str] | None = None) -> dict[str, Experiment]:
    """Packaged tables by name, or TOML files; None: all that are packaged.

    Raises:
        InputError: no such table, broken TOML, an unknown key, a value out of range, a name twice.
    """
    folder = data_folder("recipes") / "paper"
    chosen = list(PACKAGED if names is None else names)
    found = {Path(name).stem: read_toml(recipe_path(name, folder, "table"), Experiment) for name in chosen}
    if not found or len(found) < len(chosen):
        raise InputError(f"--tables {','.join(chosen)}: expected one or more tables, each once.")
    return found


def fit_of(row: Row, scored: str, scene: Scene) -> Fit | None:
    """The fit whose score of a modality stands in a row, if the field has that modality; None where the scene has no such fit.

    There is none with a modality that the scene lacks, with one beside itself, with a number of frames that the scene does not have to
    spare, and of frames without mosaic and lens to be demosaicked.

    Args:
        row: with a modality in place of ``each``.
    """
    known = list(scene.sensors)
    meant = lambda word: scored if word == "scored" else canonical_modality(word)
    named = [meant(word) for word in row.modalities if word != "all"]
    wanted = {*named, *(known if "all" in row.modalities else ())}
    if scored not in known or not wanted <= set(known) or len(set(named)) < len(named):
        return None
    if row.input == "demosaicked" and is_plain(scene):
        return None
    limits = dict.fromkeys(wanted, row.frames["all"]) if "all" in row.frames else {}
    limits |= {meant(word): limit for word, limit in row.frames.items() if word != "all"}
    if not set(limits) <= wanted:
        return None
    frames = []
    for name in known:
        limit, available = limits.get(name, 1.0), len(scene.frames_of(name, scene.split.train)) if name in limits else 0
        if limit == 1.0 and isinstance(limit, float):
            continue
        count = limit if isinstance(limit, int) else max(1, round(limit * available))
        if count >= available:
            return None
        frames.append((name, count))
    return Fit(tuple(name for name in known if name in wanted), tuple(frames), row.rays, row.input, row.prior)
