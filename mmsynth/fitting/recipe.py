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


def _key(default: Any, meaning: str, **limits: Any) -> Any:
    """A key of a section: its default, meaning [unit] and range."""
    return Field(default, description=meaning, **limits)


class SurfaceRecipe(_Section):
    """The surface: a hash grid and a small network that give the signed distance."""

    background: Switch = _key("auto", "Model what is outside the region of interest, in a contracted space twice as wide.")
    levels: int = _key(5, "Levels of the hash grid.", ge=1, le=16)
    max_rows_log2: int = _key(19, "log2 of the most rows that a level's table may have.", ge=8, le=22)
    cells_per_pixel: float = _key(1.0, "Cells of the finest level in a pixel's footprint [1/footprint].", gt=0)
    measurements_per_cell: float = _key(
        10.0, "Rays that must see a cell of the finest level, on the average [rays]; where fewer do: coarser and softer.", gt=0
    )
    cells_per_row: float = _key(1.5, "Cells of the finest level at the surface that share a row of its table [cells].", gt=0)
    rays_per_row: float = _key(150.0, "Rays of the whole fit for each row of a level's table [rays]; fewer rays: fewer rows.", gt=0)
    hidden_width: int = _key(32, "Width of the network's hidden layer.", ge=4, le=256, multiple_of=4)
    initial_radius: float | None = _key(
        None, "Radius of the sphere that a fit starts from [region radius]; left out: chosen by the scene.", gt=0, lt=1
    )
    outer_radius: float | None = _key(
        None,
        "With a background: radius of the sphere around everything that a fit starts from, in contracted space [region radius]; "
        "left out: by the cameras.",
        gt=1,
        lt=2,
    )


class RadianceRecipe(_Section):
    """The light: a hash grid of features, shaded once per ray."""

    far_light: Switch = _key(
        "auto", "Where the background is not modelled: what passes the region has a colour per direction, and is not black."
    )
    levels: int = _key(6, "Levels of the hash grid.", ge=1, le=16)
    max_rows_log2: int = _key(20, "log2 of the most rows that a level's table may have.", ge=8, le=22)
    cells_per_pixel: float = _key(2.0, "Cells of the finest level in a pixel's footprint [1/footprint].", gt=0)
    cells_per_row: float = _key(1.5, "Cells of the finest level at the surface that share a row of its table [cells].", gt=0)
    rays_per_row: float = _key(75.0, "Rays of the whole fit for each row of a level's table [rays]; fewer rays: fewer rows.", gt=0)
    hidden_width: int = _key(64, "Width of the shader's hidden layer.", ge=4, le=256)
    view_dependence: Literal["auto", 0, 1, 2, 3] = _key(
        "auto",
        "Degree of the spherical harmonics of radiance over directions; auto: views judge that are held out until then, and few views "
        "have no more harmonics than they are.",
    )
    view_dependence_min_improvement: float = _key(
        0.03, "Share of the error that a higher degree must save [1], where the degree is auto.", ge=0
    )
    light: Switch = _key("auto", "Lamps that surfaces mirror: highlights, and their polarization, by place, normal and roughness.")
    light_min_improvement: float = _key(
        0.02,
        "Share of a modality's error at rays not learned from that lamps must save [1], where light is auto; two standard errors at least, "
        "and no more where views are few.",
        ge=0,
    )
    exposure: Switch = _key("auto", "An exposure factor of every frame.")
    exposure_min_spread: float = _key(
        0.05, "Relative spread of exposure between frames that asks for these factors [1], where exposure is auto.", gt=0
    )


class SamplingRecipe(_Section):
    """Which rays a step draws, and where samples lie along them."""

    samples_per_step: int = _key(
        16384,
        "Surface samples of an optimiser step in the middle of a fit [samples]; the number of rays follows. On a GPU 262144 at least.",
        ge=256,
    )
    samples_growth: float = _key(
        4.0,
        "Samples of the last step [samples of the first]: early steps may be rough and quick, late ones average.",
        ge=1,
        le=64,
    )
    initial_rays: int = _key(256, "Rays of the first step [rays].", ge=1)
    evenly: float = _key(
        0.5, "Share of the rays that are drawn evenly from all pixels [1]; the others go where residuals are large.", gt=0, le=1
    )
    sparse_below: float = _key(
        0.3,
        "Share of the most plentiful modality's pixels [1] below which a modality is sparse: it gets fewer rays, and learns its "
        "colours from the geometry of the others.",
        ge=0,
        le=1,
    )
    step_width: float = _key(2.0, "Step between samples at the surface [1/sharpness].", gt=0)
    rendered_step_factor: float = _key(0.5, "Step of the finished field's renderings [step of the fit's end].", gt=0, le=1)
    sphere_step_factor: float = _key(0.7, "Share of the free distance that a ray goes at once, away from the surface [1].", gt=0, le=1)
    min_slope: float = _key(
        0.5,
        "A ray that approaches the surface at less than this slope takes steps as if it had it, after many samples longer ones [1].",
        gt=0,
        le=1,
    )
    roulette: float = _key(
        0.2,
        "Gradients of samples, sections and slopes below this share of their root mean square are left to chance, right in the mean [1]; "
        "0: all are added, as on a GPU.",
        ge=0,
        le=1,
    )
    min_section_weight: float = _key(1e-2, "Weight of a section below which it has no appearance of its own [1].", ge=0, lt=1)
    max_optical_depth: float = _key(3.0, "Optical depth at which a ray ends [1].", gt=0)
    occupancy_resolution: int = _key(96, "Cells of the occupancy grid along each axis [cells].", ge=8, le=256)
    occupancy_every: int = _key(32, "Steps between updates of the occupancy grid [steps].", ge=1)


class ScheduleRecipe(_Section):
    """What changes over a fit, and how fast parameters learn. Progress runs from 0 to 1."""

    sharpness_start: float = _key(
        10.0, "Sharpness of the surface at the start [1/region radius]; its soft part is 3.5 / sharpness thick.", gt=0
    )
    sharpness_per_footprint: float = _key(4.0, "Sharpness of the surface at the end [1/pixel footprint].", gt=0)
    sharpness_until: float = _key(
        0.6,
        "Progress at which the sharpness has reached its end [progress]; sooner in fits of more rays than 4.2e6, from 2.1e7 on at two "
        "thirds of it.",
        gt=0,
        le=1,
    )
    levels_until: float = _key(0.25, "Progress at which all levels of the grids are active [progress].", gt=0, le=1)
    tables_at: float = _key(
        0.05,
        "Progress at which the cells at the surface are counted, and levels not yet active get tables for as many [progress]; 0: "
        "all have the most rows.",
        ge=0,
        lt=1,
    )
    view_dependence_from: float = _key(0.3, "Progress before which radiance has no direction [progress].", ge=0, le=1)
    light_at: float = _key(0.3, "Progress at which lamps are looked for, and from which surfaces mirror them [progress].", ge=0, le=1)
    light_until: float = _key(0.45, "Progress at which residuals decide whether that is needed [progress].", ge=0, le=1)
    decide_at: float = _key(0.6, "Progress at which residuals decide on view dependence and exposure [progress].", ge=0, le=1)
    smooth_until: float = _key(0.7, "Progress up to which few views have normals pulled together [progress].", ge=0, le=1)
    learning_rate_grid: float = _key(2e-2, "Adam's rate of the hash tables [1/step].", gt=0)
    learning_rate_network: float = _key(4e-3, "Adam's rate of the networks [1/step].", gt=0)
    learning_rate_light: float = _key(8e-3, "Adam's rate of the lamps and of how surfaces mirror them [1/step].", gt=0)
    learning_rate_exposure: float = _key(1e-3, "Adam's rate of the log exposures [1/step].", gt=0)
    learning_rate_end_factor: float = _key(0.5, "All rates at the end [rate after the start].", gt=0, le=1)
    surface_epsilon: float = _key(
        2e-6,
        "Adam's epsilon of the surface's table: rows of smaller gradients (root mean square; half of them have less) move less than by "
        "the rate [1/parameter].",
        gt=0,
    )
    full_rate_sharpness: float = _key(
        80.0, "Sharpness beyond which the rates of the surface's network fall in proportion to 1 / sharpness [1/region radius].", gt=0
    )
    full_rate_sharpness_table: float = _key(
        220.0, "Sharpness beyond which the rate of the surface's table falls in proportion to 1 / sharpness [1/region radius].", gt=0
    )
    ema_fraction: float = _key(0.05, "Length of the mean over the last parameters [share of the fit]; 0: none.", ge=0, le=0.25)


class PosesRecipe(_Section):
    """Refinement of the input's poses."""

    views: Switch = _key("auto", "A rigid motion of every view.")
    rig: Switch = _key("auto", "A rigid motion of every sensor but the first, the same in all views.")
    start_at: float = _key(0.3, "Progress at which residuals decide on motions, and from which cameras move [progress].", ge=0, le=1)
    min_improvement: float = _key(
        0.01,
        "Share of the error of rays not learned from that motions must save [1], where they are auto; two standard errors at least.",
        gt=0,
    )


class LossRecipe(_Section):
    """Terms beside the photometric loss, which has weight 1."""

    eikonal_weight: float = _key(0.1, "Weight of (|∇sdf| - 1)², the pull towards a true distance [1].", ge=0)
    eikonal_shallow_early: float = _key(
        0.3,
        "Factor of slopes below 1 in it, in the region, until all levels are active [1]: in gaps they are so, and these stay open.",
        ge=0,
        le=1,
    )
    eikonal_points: int = _key(1024, "Points of a step that are asked for it [points].", ge=8)
    smooth_weight: float = _key(
        0.01,
        "Weight of the pull between normals of neighbouring places outside of the region, where views are few [1]; 0: none.",
        ge=0,
    )
    background_opacity_weight: float = _key(1.0, "Weight of opacity on black pixels of a scene whose background is black [1].", ge=0)
    alpha_weight: float = _key(
        0.5, "Weight of the squared difference of opacity and alpha, where images have it or masks of an object say it [1].", ge=0
    )
    blocked_weight: float = _key(
        0.2,
        "Weight of the optical depth of rays that are mostly blocked where alpha or masks of an object say that nothing is [1], once "
        "all levels are active: opens what has become solid there.",
        ge=0,
    )


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
