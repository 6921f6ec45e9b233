"""A fit recipe: a TOML file read into one pydantic model. Defaults live here and nowhere else."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from mmsynth.errors import InputError
from mmsynth.packaged import data_folder
from mmsynth.toml import read_toml


class Recipe(BaseModel):
    """How a field is fitted. Lengths are in units of the region's radius, progress runs from 0 to 1."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    background: Literal["auto", "on", "off"] = Field("auto", description="model what is outside the region of interest")
    beyond: Literal["auto", "on", "off"] = Field(
        "auto", description="where the background is not modelled: what passes the region has a colour per direction, and is not black"
    )
    surface_levels: int = Field(5, ge=1, le=16)
    surface_rows_log2: int = Field(16, ge=8, le=22, description="log2 of the most rows that a level may have")
    radiance_levels: int = Field(6, ge=1, le=16)
    radiance_rows_log2: int = Field(17, ge=8, le=22)
    surface_cells: float = Field(2.0, gt=0, description="finest surface grid: cells per two pixel footprints")
    radiance_cells: float = Field(4.0, gt=0, description="finest radiance grid: cells per two pixel footprints")
    cells_per_row: float = Field(1.5, gt=0, description="cells of the finest level at the surface that share a row of its hash table")
    rays_per_row: float = Field(
        50.0, gt=0, description="rays of the fit for each row of a level of the radiance's tables; half the rows for the surface's"
    )
    tables_at: float = Field(
        0.05,
        ge=0,
        lt=1,
        description="progress at which these cells are counted, for the levels that are not yet active; 0: all have the most",
    )
    measurements_per_cell: float = Field(
        10.0, gt=0, description="rays that must see a cell of the finest surface grid, on the average; fewer: coarser and softer"
    )
    surface_hidden: int = Field(32, ge=4, le=256, multiple_of=4)
    radiance_hidden: int = Field(64, ge=4, le=256)
    occupancy_resolution: int = Field(96, ge=8, le=256)
    occupancy_every: int = Field(32, ge=1, description="steps between updates of the occupancy grid")
    initial_radius: float | None = Field(None, gt=0, lt=1, description="of the sphere a fit starts from; none: chosen by the scene")
    horizon: float | None = Field(
        None, gt=1, lt=2, description="contracted radius of the sphere around everything that a fit starts from; none: by the cameras"
    )
    scarce_below: float = Field(
        0.3, ge=0, le=1, description="share of the most plentiful modality's pixels below which a modality leaves geometry to others"
    )
    samples_per_step: int = Field(16384, ge=256, description="surface samples a step; the number of rays follows")
    rays_at_start: int = Field(256, ge=1)
    sharpness_start: float = Field(10.0, gt=0)
    sharpness_end: float = Field(4.0, gt=0, description="at the end, in units of 1 / pixel footprint")
    sharpness_until: float = Field(0.6, gt=0, le=1, description="progress at which the sharpness reaches its end")
    step_width: float = Field(2.0, gt=0, description="step between samples at the surface, in units of 1 / sharpness")
    rendered_step: float = Field(0.5, gt=0, le=1, description="step of the finished field's renderings, in units of the fit's last")
    stride: float = Field(0.7, gt=0, le=1, description="share of the free distance that a ray goes at once")
    grazing: float = Field(0.5, gt=0, le=1, description="least slope towards the surface by which a ray's steps are lengthened")
    significant: float = Field(1e-2, ge=0, lt=1, description="weight of a section below which it has no appearance of its own")
    opaque: float = Field(3.0, gt=0, description="optical depth at which a ray ends")
    levels_until: float = Field(0.25, gt=0, le=1, description="progress at which all levels of the grids are active")
    view_dependence_from: float = Field(0.3, ge=0, le=1, description="progress before which radiance has no direction")
    poses: Literal["auto", "on", "off"] = Field("auto", description="a motion of every view")
    rig: Literal["auto", "on", "off"] = Field("auto", description="a motion of every sensor but the first, the same in all views")
    poses_at: float = Field(0.3, ge=0, le=1, description="progress at which residuals decide on motions, and from which cameras move")
    poses_worth: float = Field(0.01, gt=0, description="share of the error of rays not learned from that motions must save")
    decide_at: float = Field(0.6, ge=0, le=1, description="progress at which residuals decide on directions and exposure")
    view_dependence: Literal["auto", 0, 1, 2, 3] = Field("auto", description="degree of the harmonics of radiance over directions")
    view_dependence_worth: float = Field(0.05, ge=0, description="share of the error that a higher degree must save")
    exposure: Literal["auto", "on", "off"] = Field("auto", description="a gain per frame")
    exposure_worth: float = Field(0.05, gt=0, description="spread of exposure between frames that asks for gains")
    learning_rate_exposure: float = Field(1e-3, gt=0)
    learning_rate_grid: float = Field(2e-2, gt=0)
    learning_rate_network: float = Field(8e-3, gt=0)
    learning_rate_sharpness: float = Field(80.0, gt=0, description="sharpness beyond which the surface's rates fall in proportion")
    learning_rate_end: float = Field(0.5, gt=0, le=1, description="factor at the end")
    average: float = Field(0.05, ge=0, le=0.25, description="length of the mean over the last parameters, a share of the fit; 0: none")
    eikonal: float = Field(0.1, ge=0)
    eikonal_points: int = Field(1024, ge=8)
    emptiness: float = Field(1.0, ge=0, description="weight of opacity on black pixels of a black-background scene")
    opacity: float = Field(0.5, ge=0, description="weight of opacity against alpha, where images have it")


def load_recipe(name_or_path: str | None) -> Recipe:
    """A packaged recipe by name, or a TOML file.

    Raises:
        InputError: no such recipe, broken TOML, an unknown key, or a value out of range.
    """
    if name_or_path is None:
        return Recipe.model_validate({})
    path = Path(name_or_path)
    if not path.suffix:
        folder = data_folder("recipes")
        path = folder / f"{name_or_path}.toml"
        if not path.is_file():
            known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
            raise InputError(f"recipe {name_or_path!r}: not found, expected one of {known} or a TOML file.")
    return read_toml(path, Recipe)
