"""A field in a run folder: ``field.safetensors`` and what ``manifest.json`` says of it."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from mmsynth.errors import InputError, is_out_of_memory
from mmsynth.field.design import Corrections, Design
from mmsynth.field.field import Field
from mmsynth.field.kernels import Sampling
from mmsynth.field.warmup import warm_up
from mmsynth.files import read_json, sha256_of, write_atomic, write_json
from mmsynth.prior.correction import Correction
from mmsynth.prior.prediction import SceneFacts, predict
from mmsynth.prior.prior import load_prior, save_prior
from mmsynth.scene.scene import Region
from mmsynth.scene.serialisation import camera_from_json, camera_to_json, sensor_from_json, sensor_to_json

FORMAT = 2  # of the run folder; 1 had none and other names
PRIOR_FILE = "prior.safetensors"  # in it, of a field that predicts modalities
CORRECTIONS_FILE = "corrections.safetensors"  # what frames of these add


def save_field(field: Field, run: Path) -> None:
    """Write ``field.safetensors`` and ``manifest.json`` into the run folder, of a field that predicts modalities also its prior, each
    atomically, the manifest last."""
    (run / "manifest.json").unlink(missing_ok=True)  # it must not vouch for another field
    content = save({k: v.detach().cpu().contiguous() for k, v in field.state_dict().items()})
    write_atomic(run / "field.safetensors", lambda path: path.write_bytes(content))
    if field.prediction is not None:
        save_prior(field.prediction.prior, run / PRIOR_FILE)
        more = {f"{name}.{key}": t for name, c in field.prediction.corrections.items() for key, t in c.tensors().items()}
        if more:
            corrections = save(more)
            write_atomic(run / CORRECTIONS_FILE, lambda path: path.write_bytes(corrections))
        field.manifest["prior"] = {
            "sha256": sha256_of(run / PRIOR_FILE),
            "scenes": list(field.prediction.prior.scenes),
            "predicted": [sensor_to_json(s) for s in field.prediction.sensors.values()],
            "facts": asdict(field.prediction.facts),
            "corrections": {name: correction.about() for name, correction in field.prediction.corrections.items()},
        }
    field.manifest["format"] = FORMAT
    field.manifest["field"] = {
        "design": asdict(field.design),
        "sampling": field.sampling._asdict(),
        "radiance_scale": field.radiance_scale,
        "view_dependence": field.view_dependence,
        "region": asdict(field.region),
        "unit": field.unit,
        "sensors": [sensor_to_json(field.sensors[name]) for name in field.measured],
        "cameras": {n: camera_to_json(c) for n, c in field.cameras.items()},
        "rig": {n: m.tolist() for n, m in field.rig.items()},
        "corrections": {
            "views": {str(v): m.tolist() for v, m in field.corrections.views.items()},
            "sensors": {n: m.tolist() for n, m in field.corrections.sensors.items()},
        },
    }
    field.manifest["saved"] = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    write_json(run / "manifest.json", field.manifest)


def load_field(run: Path, device: str = "cpu") -> Field:
    """Read a finished run.

    Raises:
        InputError: no such run, or a file of it is missing, broken or of another version.
    """
    run = Path(run)
    path = run / "manifest.json"
    if not path.is_file():
        raise InputError(f"{run}: holds no finished fit (no manifest.json); run `mmsynth fit SCENE` first.")
    manifest = read_json(path)
    if isinstance(manifest, dict) and manifest.get("format") != FORMAT:
        found = f"format {manifest['format']}" if "format" in manifest else "no format"
        raise InputError(f"{path}: {found}, expected {FORMAT}: the run was made by another version of mmsynth; fit the scene again.")
    try:
        field = _from_json(manifest["field"])
        field.load_state_dict(load_file(run / "field.safetensors"))
        if "prior" in manifest:
            facts = SceneFacts.from_json(manifest["prior"]["facts"])
            prediction = predict(load_prior(run / PRIOR_FILE), facts, field.measured)
            about = manifest["prior"]["corrections"]
            tensors = load_file(run / CORRECTIONS_FILE) if about else {}
            corrections = {name: Correction.from_parts(stated, name, tensors) for name, stated in about.items()}
            sensors = {s["name"]: sensor_from_json(s) for s in manifest["prior"]["predicted"]}
            field.predict(replace(prediction, sensors=sensors, corrections=corrections))
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not the manifest of a fit of this version ({error}).") from error
    except (OSError, SafetensorError, RuntimeError) as error:
        if is_out_of_memory(error):
            raise
        raise InputError(f"{run / 'field.safetensors'}: could not be read ({str(error).splitlines()[0]}).") from error
    field.manifest = manifest
    if device == "cpu":
        warm_up(learning=False)  # a run may have been fitted on another machine
    return field.to(device)


def _from_json(stated: dict[str, Any]) -> Field:
    """The field that was described, with the parameters of a new one."""
    sizes: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in stated["design"].items()}
    field = Field(
        Design(**sizes),
        {s["name"]: sensor_from_json(s) for s in stated["sensors"]},
        stated["radiance_scale"],
        Region(tuple(stated["region"]["centre"]), stated["region"]["radius"]),
        stated["unit"],
        {n: camera_from_json(c) for n, c in stated["cameras"].items()},
        {n: np.array(m) for n, m in stated["rig"].items()},
    )
    field.sampling = Sampling(**stated["sampling"])
    field.view_dependence = dict(stated["view_dependence"])
    views, sensors = stated["corrections"]["views"], stated["corrections"]["sensors"]
    field.corrections = Corrections({int(v): np.array(m) for v, m in views.items()}, {n: np.array(m) for n, m in sensors.items()})
    return field
