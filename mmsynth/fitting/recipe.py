"""A fit recipe: a TOML file in sections, read into pydantic models. Defaults live here alone; recipes/README.md is made of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from mmsynth.errors import InputError
from mmsynth.packaged import data_folder
from mmsynth.toml import read_toml

Switch = Literal["auto", "on", "off"]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SurfaceRecipe(_Section):
    """The surface: a hash grid and a small network that give the signed distance."""

    background: Switch = Field("auto", description="Model what is outside the region of interest, in a contracted space twice as wide.")
    levels: int = Field(5, ge=1, le=16, description="Levels of the hash grid.")
    max_rows_log2: int = Field(16, ge=8, le=22, description="log2 of the most rows that a level's table may have.")
    cells_per_pixel: float = Field(1.0, gt=0, description="Cells of the finest level in a pixel's footprint [1/footprint].")
    measurements_per_cell: float = Field(
        10.0, gt=0, description="Rays that must see a cell of the finest level, on the average [rays]; where fewer do: coarser and softer."
    )
    cells_per_row: float = Field(1.5, gt=0, description="Cells of the finest level at the surface that share a row of its table [cells].")
    rays_per_row: float = Field(
        100.0, gt=0, description="Rays of the whole fit for each row of a level's table [rays]; fewer rays: fewer rows."
    )
    hidden_width: int = Field(32, ge=4, le=256, multiple_of=4, description="Width of the network's hidden layer.")
    initial_radius: float | None = Field(
        None, gt=0, lt=1, description="Radius of the sphere that a fit starts from [region radius]; left out: chosen by the scene."
    )
    outer_radius: float | None = Field(
        None,
        gt=1,
        lt=2,
        description="With a background: radius of the sphere around everything that a fit starts from, in contracted space "
        "[region radius]; left out: by the cameras.",
    )


class RadianceRecipe(_Section):
    """The light: a hash grid of features, shaded once per ray."""

    far_light: Switch = Field(
        "auto", description="Where the background is not modelled: what passes the region has a colour per direction, and is not black."
    )
    levels: int = Field(6, ge=1, le=16, description="Levels of the hash grid.")
    max_rows_log2: int = Field(17, ge=8, le=22, description="log2 of the most rows that a level's table may have.")
    cells_per_pixel: float = Field(2.0, gt=0, description="Cells of the finest level in a pixel's footprint [1/footprint].")
    cells_per_row: float = Field(1.5, gt=0, description="Cells of the finest level at the surface that share a row of its table [cells].")
    rays_per_row: float = Field(
        50.0, gt=0, description="Rays of the whole fit for each row of a level's table [rays]; fewer rays: fewer rows."
    )
    hidden_width: int = Field(64, ge=4, le=256, description="Width of the shader's hidden layer.")
    view_dependence: Literal["auto", 0, 1, 2, 3] = Field(
        "auto", description="Degree of the spherical harmonics of radiance over directions."
    )
    view_dependence_min_improvement: float = Field(
        0.05, ge=0, description="Share of the error that a higher degree must save [1], where the degree is auto."
    )
    exposure: Switch = Field("auto", description="An exposure factor of every frame.")
    exposure_min_spread: float = Field(
        0.05, gt=0, description="Relative spread of exposure between frames that asks for these factors [1], where exposure is auto."
    )


class SamplingRecipe(_Section):
    """Which rays a step draws, and where samples lie along them."""

    samples_per_step: int = Field(16384, ge=256, description="Surface samples of an optimiser step [samples]; the number of rays follows.")
    initial_rays: int = Field(256, ge=1, description="Rays of the first step [rays].")
    sparse_below: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Share of the most plentiful modality's pixels [1] below which a modality is sparse: it gets fewer rays, and learns "
        "its colours from the geometry of the others.",
    )
    step_width: float = Field(2.0, gt=0, description="Step between samples at the surface [1/sharpness].")
    rendered_step_factor: float = Field(0.5, gt=0, le=1, description="Step of the finished field's renderings [step of the fit's end].")
    sphere_step_factor: float = Field(
        0.7, gt=0, le=1, description="Share of the free distance that a ray goes at once, away from the surface [1]."
    )
    min_slope: float = Field(
        0.5, gt=0, le=1, description="A ray that approaches the surface at less than this slope takes steps as if it had it [1]."
    )
    min_section_weight: float = Field(1e-2, ge=0, lt=1, description="Weight of a section below which it has no appearance of its own [1].")
    max_optical_depth: float = Field(3.0, gt=0, description="Optical depth at which a ray ends [1].")
    occupancy_resolution: int = Field(96, ge=8, le=256, description="Cells of the occupancy grid along each axis [cells].")
    occupancy_every: int = Field(32, ge=1, description="Steps between updates of the occupancy grid [steps].")


class ScheduleRecipe(_Section):
    """What changes over a fit, and how fast parameters learn. Progress runs from 0 to 1."""

    sharpness_start: float = Field(
        10.0, gt=0, description="Sharpness of the surface at the start [1/region radius]; its soft part is 3.5 / sharpness thick."
    )
    sharpness_per_footprint: float = Field(4.0, gt=0, description="Sharpness of the surface at the end [1/pixel footprint].")
    sharpness_until: float = Field(0.6, gt=0, le=1, description="Progress at which the sharpness has reached its end [progress].")
    levels_until: float = Field(0.25, gt=0, le=1, description="Progress at which all levels of the grids are active [progress].")
    tables_at: float = Field(
        0.05,
        ge=0,
        lt=1,
        description="Progress at which the cells at the surface are counted, and levels not yet active get tables for as many [progress]; "
        "0: all have the most rows.",
    )
    view_dependence_from: float = Field(0.3, ge=0, le=1, description="Progress before which radiance has no direction [progress].")
    decide_at: float = Field(0.6, ge=0, le=1, description="Progress at which residuals decide on view dependence and exposure [progress].")
    learning_rate_grid: float = Field(2e-2, gt=0, description="Adam's rate of the hash tables [1/step].")
    learning_rate_network: float = Field(8e-3, gt=0, description="Adam's rate of the networks [1/step].")
    learning_rate_exposure: float = Field(1e-3, gt=0, description="Adam's rate of the log exposures [1/step].")
    learning_rate_end_factor: float = Field(0.5, gt=0, le=1, description="All rates at the end [rate after the start].")
    full_rate_sharpness: float = Field(
        80.0, gt=0, description="Sharpness beyond which the surface's rates fall in proportion to 1 / sharpness [1/region radius]."
    )
    ema_fraction: float = Field(0.05, ge=0, le=0.25, description="Length of the mean over the last parameters [share of the fit]; 0: none.")


class PosesRecipe(_Section):
    """Refinement of the input's poses."""

    views: Switch = Field("auto", description="A rigid motion of every view.")
    rig: Switch = Field("auto", description="A rigid motion of every sensor but the first, the same in all views.")
    start_at: float = Field(
        0.3, ge=0, le=1, description="Progress at which residuals decide on motions, and from which cameras move [progress]."
    )
    min_improvement: float = Field(
        0.01, gt=0, description="Share of the error of rays not learned from that motions must save [1], where they are auto."
    )


class LossRecipe(_Section):
    """Terms beside the photometric loss, which has weight 1."""

    eikonal_weight: float = Field(0.1, ge=0, description="Weight of (|∇sdf| - 1)², the pull towards a true distance [1].")
    eikonal_points: int = Field(1024, ge=8, description="Points of a step that are asked for it [points].")
    background_opacity_weight: float = Field(
        1.0, ge=0, description="Weight of opacity on black pixels of a scene whose background is black [1]."
    )
    alpha_weight: float = Field(0.5, ge=0, description="Weight of the squared difference of opacity and alpha, where images have it [1].")


class Recipe(_Section):
    """How a field is fitted."""

    surface: SurfaceRecipe = SurfaceRecipe.model_validate({})
    radiance: RadianceRecipe = RadianceRecipe.model_validate({})
    sampling: SamplingRecipe = SamplingRecipe.model_validate({})
    schedule: ScheduleRecipe = ScheduleRecipe.model_validate({})
    poses: PosesRecipe = PosesRecipe.model_validate({})
    loss: LossRecipe = LossRecipe.model_validate({})

    @model_validator(mode="before")
    @classmethod
    def _in_sections(cls, given: Any) -> Any:
        known = ", ".join(f"[{name}]" for name in cls.model_fields)
        for name, value in given.items() if isinstance(given, Mapping) else ():
            if name not in cls.model_fields or not isinstance(value, Mapping | BaseModel):
                raise ValueError(f"{name}: is no section of a recipe, expected keys in the sections {known}, see recipes/README.md")
        return given

    def with_changes(self, changes: Mapping[str, Any]) -> Recipe:
        """The same with other values of some keys, by dotted name: ``{"surface.levels": 4}``.

        Raises:
            pydantic.ValidationError: an unknown key, or a value out of range.
        """
        sections: dict[str, Any] = self.model_dump()
        for name, value in changes.items():
            section, _, key = name.partition(".")
            sections.setdefault(section, {})[key] = value
        return Recipe.model_validate(sections)


def load_recipe(name_or_path: str | None) -> Recipe:
    """A packaged recipe by name, or a TOML file; None: the defaults.

    Raises:
        InputError: no such recipe, broken TOML, an unknown key, or a value out of range.
    """
    return Recipe() if name_or_path is None else read_toml(recipe_path(name_or_path, data_folder("recipes"), "recipe"), Recipe)


def recipe_path(name_or_path: str, folder: Path, what: str) -> Path:
    """A TOML file, or the one of this name in a folder."""
    path = Path(name_or_path)
    if not path.suffix:
        path = folder / f"{name_or_path}.toml"
        if not path.is_file():
            known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
            raise InputError(f"{what} {name_or_path!r}: not found, expected one of {known} or a TOML file.")
    return path


def keys_as_markdown() -> str:
    """Every key of a recipe with its default, range and meaning: the part of recipes/README.md that is made."""
    parts = []
    for section, field in Recipe.model_fields.items():
        model = field.annotation
        assert isinstance(model, type) and issubclass(model, BaseModel)
        lines = [f"### [{section}]", "", model.__doc__ or "", "", "| key | default | allowed | meaning [unit] |", "|:--|:--|:--|:--|"]
        for key, schema in model.model_json_schema()["properties"].items():
            default = "left out" if schema["default"] is None else schema["default"]
            lines.append(f"| `{key}` | {default} | {_allowed(schema)} | {schema['description'].replace('|', chr(92) + '|')} |")
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _allowed(schema: Mapping[str, Any]) -> str:
    """The range of a key, from its JSON schema."""
    schema = next((s for s in schema.get("anyOf", ()) if s["type"] != "null"), schema)
    if "enum" in schema:
        return ", ".join(map(str, schema["enum"]))
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<", "multipleOf": "multiple of"}
    return ", ".join(f"{sign} {schema[name]:g}" for name, sign in signs.items() if name in schema)
