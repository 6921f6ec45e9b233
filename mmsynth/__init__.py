"""mmsynth: one radiance field of a scene from the raw frames of several sensors, and what no rig could capture from it.

What a command does is one call:

* ``mmsynth calibrate``: ``calibrate_rig`` → ``Calibration``: a rig from frames of boards, with its files.
* ``mmsynth info``: ``load_scene`` → ``Scene``: sensors, frames with cameras and poses, split, problems.
* ``mmsynth fit``: ``fit_run`` → ``Run``: a fit with its report and ``runs/latest``. ``fit``: the field alone.
* ``mmsynth prior``: ``make_prior``; ``find_prior`` reads one, for ``fit_run(..., prior=...)``.
* ``mmsynth view``: ``serve(open_viewer(run.field, run.scene, run.folder))``. ``mmsynth video``: ``write_video``.
* ``mmsynth evaluate``: ``evaluate_run(open_run())``, ``evaluate_conversions``. ``evaluate``: the scores alone.
* ``mmsynth convert``: ``convert_files``. ``convert``: tensors in, tensors out.
* ``mmsynth generate-dataset``: ``generate_dataset``, ``verify_dataset``. ``AlignedDataset`` reads one for training.
* ``mmsynth simulate``: ``simulate``. ``SensorTwin``: the effects of one sensor on tensors.
* ``mmsynth calibrate-noise``: ``calibrate_noise``.
* ``mmsynth mesh``: ``mesh_to_file``. ``extract_mesh`` and ``write_mesh``: in memory, then to a file.
* ``mmsynth export``: ``export_scene``.
* ``mmsynth pose``: ``pose_scene``.
* ``mmsynth batch``: ``run_batch``.

A ``Field`` renders any camera at any pose: ``Field.render`` → ``Rendering``. A ``Recipe`` holds every number of a fit. Bad input raises
``InputError``, a fit that diverged ``DivergedError``, with one sentence each. Names are loaded when first used, so that ``mmsynth --help``
does not wait for torch.

The command line sets ``GOMP_SPINCOUNT=1000`` before torch is loaded, so that its threads do not spin beside another busy process, and looks
for garbage less often, so that it starts sooner; a script may want the same (``mmsynth.process``). ``OMP_NUM_THREADS`` limits the threads
of kernels, too.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mmsynth.version import __version__ as __version__

if TYPE_CHECKING:
    from mmsynth.errors import DivergedError, InputError
    from mmsynth.field.field import Field
    from mmsynth.field.picture import Rendering
    from mmsynth.fitting.recipe import Recipe, load_recipe
    from mmsynth.fitting.run import fit
    from mmsynth.operations.conversion.files import convert_files
    from mmsynth.operations.conversion.methods import convert
    from mmsynth.operations.dataset.aligned import AlignedDataset
    from mmsynth.operations.dataset.generate import generate_dataset
    from mmsynth.operations.dataset.index import verify_dataset
    from mmsynth.operations.evaluation.conversions import evaluate_conversions
    from mmsynth.operations.evaluation.evaluate import evaluate
    from mmsynth.operations.export.export import export_scene
    from mmsynth.operations.mesh.extract import extract_mesh, mesh_to_file
    from mmsynth.operations.mesh.files import write_mesh
    from mmsynth.operations.simulation.calibrate_noise import calibrate_noise
    from mmsynth.operations.simulation.simulate import simulate
    from mmsynth.operations.views.video import write_video
    from mmsynth.scene.load import load_scene
    from mmsynth.sensors.twin import SensorTwin
    from mmsynth.viewer.open import open_viewer, serve
    from mmsynth.workflows.batch import run_batch
    from mmsynth.workflows.calibrate import calibrate_rig
    from mmsynth.workflows.fit import evaluate_run, fit_run
    from mmsynth.workflows.pose import pose_scene
    from mmsynth.workflows.prior import find_prior, make_prior
    from mmsynth.workflows.runs import Run, open_run

_NAMES = {
    "errors": "DivergedError InputError",
    "field.field": "Field",
    "field.picture": "Rendering",
    "fitting.recipe": "Recipe load_recipe",
    "fitting.run": "fit",
    "operations.conversion.files": "convert_files",
    "operations.conversion.methods": "convert",
    "operations.dataset.aligned": "AlignedDataset",
    "operations.dataset.generate": "generate_dataset",
    "operations.dataset.index": "verify_dataset",
    "operations.evaluation.conversions": "evaluate_conversions",
    "operations.evaluation.evaluate": "evaluate",
    "operations.export.export": "export_scene",
    "operations.mesh.extract": "extract_mesh mesh_to_file",
    "operations.mesh.files": "write_mesh",
    "operations.simulation.calibrate_noise": "calibrate_noise",
    "operations.simulation.simulate": "simulate",
    "operations.views.video": "write_video",
    "scene.load": "load_scene",
    "sensors.twin": "SensorTwin",
    "viewer.open": "open_viewer serve",
    "workflows.batch": "run_batch",
    "workflows.calibrate": "calibrate_rig",
    "workflows.fit": "evaluate_run fit_run",
    "workflows.pose": "pose_scene",
    "workflows.prior": "find_prior make_prior",
    "workflows.runs": "Run open_run",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "AlignedDataset", "DivergedError", "Field", "InputError", "Recipe", "Rendering", "Run", "SensorTwin", "calibrate_noise",
    "calibrate_rig", "convert", "convert_files", "evaluate", "evaluate_conversions", "evaluate_run", "export_scene", "extract_mesh",
    "find_prior", "fit", "fit_run", "generate_dataset", "load_recipe", "load_scene", "make_prior",
    "mesh_to_file", "open_run", "open_viewer", "pose_scene", "run_batch", "serve", "simulate",
    "verify_dataset", "write_mesh", "write_video",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mmsynth' has no attribute {name!r}")
    return getattr(importlib.import_module(f"mmsynth.{_HOMES[name]}"), name)
