"""One mesh, measured: the process that ``bench mesh`` starts (see ``worker``)."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from skimage.measure import marching_cubes

from mmsynth.bench.machine import peak_memory
from mmsynth.bench.worker import serve
from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.field.storage import load_field
from mmsynth.operations.mesh.attributes import training_views
from mmsynth.operations.mesh.extract import MeshOptions, extract_mesh
from mmsynth.operations.mesh.quality import compare_meshes, describe_mesh, load_reference
from mmsynth.scene.load import load_again
from mmsynth.scene.scene import Scene

_BLOCK = 64


def every_block(field: Field, scene: Scene, n: int) -> trimesh.Trimesh:
    """The usual way (Neuralangelo, sdfstudio, MultimodalStudio): every block evaluated, marched alone, and put beside the others."""
    centre, radius = np.array(field.region.centre), field.region.radius
    vertices, faces, total = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    for low in itertools.product(range(0, n, _BLOCK), repeat=3):
        shape = [min(_BLOCK, n - i) + 1 for i in low]
        points = np.indices(shape).reshape(3, -1).T + np.array(low)
        values = field.sdf(centre - radius + points * (2.0 * radius / n)).reshape(shape)
        if values.min() < 0 < values.max():
            v, f, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
            vertices.append(centre - radius + (v + np.array(low)) * (2.0 * radius / n))
            faces.append(f.astype(np.int64) + total)
            total += len(v)
    v, f = np.concatenate(vertices), np.concatenate(faces)
    f = f[np.linalg.norm(v[f].mean(1) - centre, axis=1) <= radius]
    if not len(f):
        raise InputError("mesh: the field has no surface in the region of interest.")
    return trimesh.Trimesh(v, f, process=False)


METHODS: dict[str, Callable[[Field, Scene, int], trimesh.Trimesh]] = {
    "every block": every_block,
    "mmsynth": lambda field, scene, n: extract_mesh(field, MeshOptions(n)),
    "mmsynth, closed": lambda field, scene, n: extract_mesh(field, MeshOptions(n, closed=True)),
    "mmsynth, all modalities": lambda field, scene, n: extract_mesh(field, MeshOptions(n), scene=scene),
}


def work(task: Mapping[str, Any]) -> dict[str, Any]:
    """Mesh a field and score the mesh.

    Returns:
        ``seconds``, ``cpu_share`` and ``peak_memory_bytes`` (all of the process) of the extraction, ``mesh`` (see ``describe_mesh``),
        ``against`` (see ``compare_meshes``) where the task has a reference.
    Raises:
        InputError: no such run, scene or reference, or nothing to mesh.
    """
    field = load_field(Path(task["run"]))
    scene = load_again(field.manifest["scene"], modalities=list(field.sensors))
    reference = None if task["against"] is None else load_reference(Path(task["against"]))
    began, cpu = time.perf_counter(), time.process_time()
    mesh = METHODS[task["method"]](field, scene, task["resolution"])
    seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
    out: dict[str, Any] = {"seconds": seconds, "cpu_share": cpu / (seconds * torch.get_num_threads()), "peak_memory_bytes": peak_memory()}
    mesh.metadata["unit"] = field.unit
    sdf = None if task["method"] == "mmsynth, closed" else field.sdf  # the border's cap is no zero of the field
    out["mesh"] = describe_mesh(mesh, sdf, 2.0 * field.region.radius / task["resolution"])
    if reference is not None:
        views = training_views(field, scene)
        out["against"] = compare_meshes(mesh, reference, region=field.region, views=views, distances=task["distances"])
    return out


if __name__ == "__main__":
    serve(work)
