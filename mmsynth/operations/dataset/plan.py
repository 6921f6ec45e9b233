"""What is to be made of a request for a dataset: which cameras see each view, in which groups, and by what key a finished view is known."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from mmsynth.errors import InputError
from mmsynth.operations.dataset import index
from mmsynth.operations.output.records import RecordFormat, field_hash
from mmsynth.operations.views.coverage import TrainingRays
from mmsynth.operations.views.load import RIGS, Rig, on_the_rig
from mmsynth.scene.layouts.mmsdata import meta_content
from mmsynth.scene.scene import PosedCamera, canonical_modality
from mmsynth.scene.serialisation import CONVENTIONS, channels_to_json, posed_to_json
from mmsynth.version import __version__

if TYPE_CHECKING:
    from mmsynth.field.field import Field

DatasetFormat = Literal[RecordFormat, "webdataset", "mms-data"]
DATASET_FORMATS: tuple[DatasetFormat, ...] = get_args(DatasetFormat)
OUTPUTS = ("geometry", "flow", "coverage", "light")
LAYOUT = 2

Placed = dict[str, PosedCamera]  # of each modality at one view


@dataclass(frozen=True)
class Plan:
    """What is to be made. keys: hash of everything that decides a view's files; it, placed (cameras) and stated by view. shards: finished
    ones, by name."""

    field: Field
    out: Path
    rig: Rig
    format: DatasetFormat
    outputs: tuple[str, ...]
    rays: TrainingRays | None
    request: dict[str, Any]
    groups: list[list[str]]
    placed: list[Placed]
    stated: list[dict[str, Any]]
    keys: list[str]
    shards: dict[str, list[dict[str, Any]]]

    def finished(self, view: int) -> dict[str, Any] | None:
        """What the sidecar of a finished view says, be it in a folder or in a shard."""
        if self.format == "webdataset":
            shard = self.shard(view)
            if shard is not None:
                return shard[view % index.PER_SHARD]
        return index.finished_view(self.out, view, self.keys[view])

    def shard(self, view: int) -> list[dict[str, Any]] | None:
        name, first = index.shard_name(view), view // index.PER_SHARD * index.PER_SHARD
        if name not in self.shards:
            made = index.finished_shard(self.out, name, self.keys[first : first + index.PER_SHARD])
            if made is None:
                return None
            self.shards[name] = made
            index.drop_views(self.out, range(first, first + len(made)))  # left over where a run was cut off
        return self.shards[name]


def check_request(
    field: Field, modalities: Sequence[str] | None, rig: Rig, file_format: DatasetFormat, outputs: Sequence[str] | None
) -> tuple[list[str], tuple[str, ...]]:
    """Canonical names of the modalities, and the outputs in their order; what cannot be made is said before anything is rendered."""
    if rig not in RIGS:
        raise InputError(f"dataset: rig is {rig!r}, expected one of {', '.join(RIGS)}.")
    if file_format not in DATASET_FORMATS:
        raise InputError(f"dataset: format is {file_format!r}, expected one of {', '.join(DATASET_FORMATS)}.")
    names = field.check_modalities(None if modalities is None else [canonical_modality(m) for m in modalities])
    if not names:
        raise InputError("dataset: no modalities, expected at least one.")
    unknown = [o for o in outputs or () if o not in OUTPUTS]
    if unknown:
        raise InputError(f"dataset: output {unknown[0]!r}, expected some of {', '.join(OUTPUTS)}.")
    if outputs is not None and "light" in outputs and not field.shines:
        raise InputError("dataset: output 'light', but this field has no lamps that surfaces mirror (see `light` in the run's report).")
    return names, tuple(o for o in OUTPUTS if (outputs is None and o != "light") or (outputs is not None and o in outputs))


def plan_dataset(
    field: Field,
    views: Sequence[PosedCamera],
    out: Path,
    names: Sequence[str],
    rig: Rig,
    file_format: DatasetFormat,
    wanted: tuple[str, ...],
    rays: TrainingRays | None,
) -> Plan:
    wanted = tuple(o for o in wanted if o != "coverage" or rays is not None)
    placed = [_place(field, names, view, rig) for view in views]
    if file_format == "mms-data":
        meta_of(field, out, names, placed)  # what it does not hold is said before anything is rendered
    fit = {key: field.manifest.get(key) for key in ("recipe", "seed", "scene", "steps")}
    request = {
        "layout": LAYOUT,
        "field": field_hash(field),
        "fit": fit,
        "rig": rig,
        "format": file_format,
        "outputs": list(wanted),
        "modalities": {
            name: channels_to_json(field.sensors[name]) | ({"predicted": True} if name in field.predicted else {}) for name in names
        },
        "unit": field.unit,
        "conventions": CONVENTIONS,
        "versions": {"mmsynth": __version__} | {package: version(package) for package in ("numpy", "torch")},
    }
    stated = [
        {"name": view.name, "cameras": {m: posed_to_json(seen_by) for m, seen_by in cameras.items()}}
        for view, cameras in zip(views, placed, strict=True)
    ]
    request_text = json.dumps(request, sort_keys=True)
    seen_from = None if rays is None or "coverage" not in wanted else hashlib.sha256(rays.poses.tobytes()).hexdigest()
    # the flow of a view depends on where the next one is
    following = [view["cameras"] if "flow" in wanted else None for view in stated[1:]] + [None]
    keys = [
        hashlib.sha256(json.dumps([request_text, seen_from, view, after], sort_keys=True).encode()).hexdigest()
        for view, after in zip(stated, following, strict=True)
    ]
    groups = [list(names)] if rig == "aligned" else [[name] for name in names]
    return Plan(field, out, rig, file_format, wanted, rays, request, groups, placed, stated, keys, {})


def _place(field: Field, names: Sequence[str], view: PosedCamera, rig: Rig) -> Placed:
    """Camera and pose of each modality at one view."""
    reference = next(iter(field.sensors))
    own = lambda name: rig == "aligned" or name == reference
    return {name: view if own(name) else on_the_rig(field, view, reference, name) for name in names}


def meta_of(field: Field, out: Path, names: Sequence[str], placed: Sequence[Placed]) -> dict[str, Any]:
    """meta_data.json of a scene whose frames have all channels at every pixel."""
    sensors = [replace(field.sensors[name], mosaic=None) for name in names]
    frames = {name: {i: replace(cameras[name], name=f"{i:04d}.tiff") for i, cameras in enumerate(placed)} for name in names}
    return meta_content(out, sensors, frames, field.region, field.unit)
