"""Samples for a prior from the noise-free truth of a scene, where it has that."""

from __future__ import annotations

import numpy as np
import torch

from mmsynth.errors import InputError
from mmsynth.operations.evaluation.parts import parts_of
from mmsynth.prior.samples import SceneSamples, shapes_of
from mmsynth.scene.exposure import stated_exposure
from mmsynth.scene.ground_truth import GroundTruth
from mmsynth.scene.scene import Scene
from mmsynth.sensors.camera import ray_map
from mmsynth.sensors.polarization import reference_axes

_PIXELS = 24_576


def sample_truth(scene: Scene, *, seed: int = 0) -> SceneSamples:
    """Light of all modalities, and the surfaces, at random pixels of ``gt/aligned`` and ``gt/geometry`` in the region of interest.

    Highlights are left out: in truth they are not told from the body's light, and what lamps' images are the light model knows.

    Raises:
        InputError: there is no such truth.
    """
    truth, labels = GroundTruth(scene), GroundTruth(scene).labels()
    polarized = next((name for name, sensor in scene.sensors.items() if sensor.is_polarization), None)
    found: dict[str, list[np.ndarray]] = {}
    for frame in scene.frames_of(next(iter(scene.sensors))):
        light, geometry = truth.aligned(frame.view), truth.geometry(frame.view)
        if geometry is None or not all(name in light for name in scene.sensors):
            continue
        where = geometry["in_roi"].astype(bool) & (np.linalg.norm(geometry["normal"].astype(np.float64), axis=-1) > 0.5)
        where &= ~parts_of(light[next(iter(scene.sensors))].astype(np.float32), geometry, labels, where)["highlights"]
        for name in scene.sensors:
            found.setdefault(name, []).append(light[name][where].astype(np.float64))
        directions = ray_map(frame.camera)[0] @ frame.camera_to_world[:3, :3].T
        found.setdefault("direction", []).append(directions[where])
        found.setdefault("normal", []).append(geometry["normal"][where].astype(np.float64))
        found.setdefault("camera_x", []).append(np.broadcast_to(frame.camera_to_world[:3, 0], (int(where.sum()), 3)))
    if not found:
        raise InputError(
            f"{scene.root}: no aligned truth of all modalities (gt/aligned and gt/geometry), expected some, or a fit of the scene."
        )
    joined = {key: np.concatenate(values) for key, values in found.items()}
    count = len(joined["normal"])
    chosen = np.random.default_rng(seed).choice(count, min(count, _PIXELS), replace=False)
    joined = {key: values[chosen] for key, values in joined.items()}
    normals, directions, camera_x = (torch.from_numpy(joined[key]).float() for key in ("normal", "direction", "camera_x"))
    zero = torch.zeros(len(chosen))
    return SceneSamples(
        name=scene.root.resolve().name,
        sensors=dict(scene.sensors),
        exposure=stated_exposure(scene),
        body={name: joined[name][:, :1] if sensor.is_polarization else joined[name] for name, sensor in scene.sensors.items()},
        lamp=None,
        images=np.zeros((len(chosen), 3)),
        polarized=None if polarized is None else joined[polarized][:, 1:],
        shapes=shapes_of(normals, directions, *reference_axes(directions, camera_x), zero, zero),
    )
