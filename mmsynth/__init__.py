"""mmsynth: one radiance field of a scene from the raw frames of several sensors, and what no rig could capture from it.

The names below are loaded when first used, so that ``mmsynth --help`` does not wait for torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mmsynth.version import __version__ as __version__

if TYPE_CHECKING:
    from mmsynth.errors import DivergedError, InputError
    from mmsynth.field.field import Field, Rendering
    from mmsynth.fitting.recipe import Recipe, load_recipe
    from mmsynth.fitting.run import fit
    from mmsynth.operations.conversion.methods import convert
    from mmsynth.operations.dataset.aligned import AlignedDataset
    from mmsynth.operations.dataset.generate import generate_dataset
    from mmsynth.operations.evaluation.evaluate import evaluate
    from mmsynth.operations.mesh.extract import extract_mesh
    from mmsynth.operations.mesh.files import write_mesh
    from mmsynth.operations.simulation.calibrate_noise import calibrate_noise
    from mmsynth.operations.simulation.simulate import simulate
    from mmsynth.scene.load import load_scene
    from mmsynth.sensors.twin import SensorTwin

_HOMES = {
    "AlignedDataset": "operations.dataset.aligned",
    "DivergedError": "errors",
    "InputError": "errors",
    "Field": "field.field",
    "Rendering": "field.field",
    "SensorTwin": "sensors.twin",
    "calibrate_noise": "operations.simulation.calibrate_noise",
    "Recipe": "fitting.recipe",
    "load_recipe": "fitting.recipe",
    "fit": "fitting.run",
    "convert": "operations.conversion.methods",
    "generate_dataset": "operations.dataset.generate",
    "evaluate": "operations.evaluation.evaluate",
    "extract_mesh": "operations.mesh.extract",
    "write_mesh": "operations.mesh.files",
    "load_scene": "scene.load",
    "simulate": "operations.simulation.simulate",
}
__all__ = [
    "AlignedDataset",
    "DivergedError",
    "Field",
    "InputError",
    "Recipe",
    "Rendering",
    "SensorTwin",
    "calibrate_noise",
    "convert",
    "evaluate",
    "extract_mesh",
    "fit",
    "generate_dataset",
    "load_recipe",
    "load_scene",
    "simulate",
    "write_mesh",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mmsynth' has no attribute {name!r}")
    return getattr(importlib.import_module(f"mmsynth.{_HOMES[name]}"), name)
