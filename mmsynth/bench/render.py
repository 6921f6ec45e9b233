"""``mmsynth bench render``: rays per second of a fitted field against error, by what a ray is sampled with and what is asked of it.

The error is that of sampling alone: each way to render is judged by a fine rendering of the same field, which single operations of
torch make from rays that are never cut off, not by the kernel that is timed. Variants take turns, see ``methods``. To add one, add a
``Variant`` to its family.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mmsynth.bench.machine import measure, use_threads
from mmsynth.bench.methods import Method, chosen_families, family_tables, measured
from mmsynth.bench.output import Report, scatter_panels, write_report
from mmsynth.bench.tables import Column, numbers
from mmsynth.errors import InputError
from mmsynth.field import kernels, rendering
from mmsynth.field.field import TILE, Field
from mmsynth.field.kernels import Sampling, reference
from mmsynth.operations.output.progress import Progress
from mmsynth.parallel import side_by_side
from mmsynth.scene.scene import Scene
from mmsynth.sensors.camera import ray_map
from mmsynth.threads import kernel_threads

REPEATS = 5
VIEWS, RAYS = 4, 65536
FINE_STEP, FINE_STRIDE, FINE_OPAQUE = 0.25, 0.35, 12.0  # of the reference; all its sections have their own appearance
_FINE_MOST = 4096  # samples of one of its rays
_FINE_RAYS = 4096  # of it at a time
Outputs = dict[str, Tensor]


@dataclass(frozen=True)
class Rays:
    """Rays of some views, R in all, in the field's normalised frame: origins, directions, camera_x (R, 3)."""

    origins: Tensor
    directions: Tensor
    camera_x: Tensor

    def __len__(self) -> int:
        return len(self.origins)

    def tiles(self, size: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """By at most ``size`` rays: their origins, directions and camera_x."""
        return zip(self.origins.split(size), self.directions.split(size), self.camera_x.split(size), strict=True)


@dataclass(frozen=True)
class Truth:
    """The reference: outputs, of all modalities and with geometry; samples: taken per ray; error: how far a reference of twice the
    step is from it, root mean square in parts of full scale."""

    outputs: Outputs
    samples: float
    error: float


@dataclass(frozen=True)
class RenderCase:
    """What all families render: a field's rays, and what is right for them."""

    field: Field
    rays: Rays
    truth: Truth

    @property
    def sets(self) -> dict[str, list[str]]:
        """Modalities that are rendered together: one, and all."""
        names = list(self.field.sensors)
        return {names[0]: names[:1]} | ({f"all {len(names)}": names} if len(names) > 1 else {})


@dataclass(frozen=True)
class Variant:
    """One way to render: with a sampling, by tiles of so many rays, on ``threads`` (None: those of the bench)."""

    problem: str
    name: str
    modalities: Sequence[str]
    sampling: Sampling
    geometry: bool = False
    tile: int = TILE
    threads: int | None = None


# --- rays and their truth


def rays_of(field: Field, scene: Scene) -> Rays:
    """At most ``RAYS`` rays of ``VIEWS`` training views of the field's reference camera: whole rows, evenly spread.

    Raises:
        InputError: the scene has no frame of it.
    """
    name = next(iter(field.sensors))
    frames = scene.frames_of(name, scene.split.train) or scene.frames_of(name)
    if not frames:
        raise InputError(f"bench render: the scene has no frame of {name}, the reference camera of the field.")
    chosen = [frames[i] for i in sorted({round(i) for i in np.linspace(0, len(frames) - 1, VIEWS)})]
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for frame in chosen:
        directions, valid = ray_map(frame.camera)
        height, width = valid.shape
        rows = np.unique(np.linspace(0, height - 1, min(height, max(1, RAYS // len(chosen) // width))).round().astype(int))
        parts.append(field.rays_of(directions[rows][valid[rows]], field.pose_of(frame)))
    return Rays(*(torch.cat(x) for x in zip(*parts, strict=True)))


def fine(sampling: Sampling, coarser: float = 1.0) -> Sampling:
    """The sampling of the reference, or one of a longer step."""
    return sampling._replace(
        max_optical_depth=FINE_OPAQUE,
        step=sampling.step * FINE_STEP * coarser,
        sphere_step_factor=FINE_STRIDE * coarser,
        min_section_weight=0.0,
    )


@torch.no_grad()
def truth_of(field: Field, rays: Rays) -> Truth:
    """Render the reference, and one of twice the step to tell how sure it is."""
    outputs, samples = _exact(field, rays, fine(field.sampling))
    coarse, _ = _exact(field, rays, fine(field.sampling, 2.0))
    return Truth(outputs, samples, difference(coarse, outputs, list(field.sensors))["error"])


def _exact(field: Field, rays: Rays, sampling: Sampling) -> tuple[Outputs, float]:
    """By single operations, and not as many samples a ray as the kernel has room for but as many as it takes."""
    surface, parts, samples = field.surface, [], 0
    sdf = lambda x: surface(x, sampling.active_surface)
    for origins, directions, camera_x in rays.tiles(_FINE_RAYS):
        near, far = rendering.interval(surface, origins, directions)
        marched = kernels.Rays(origins, directions, near, far, torch.full_like(near, 0.5))
        taken = reference.march(sdf, marched, field.occupancy.states, surface.grid.extent, sampling, _FINE_MOST)
        hits = reference.composite(sdf, field.appearance.at(sampling.active_radiance), marched, taken, sampling)
        samples += int(hits.samples)
        parts.append(field.shade_hits(hits, origins, directions, camera_x, list(field.sensors), True))
    return _joined(parts), samples / len(rays)


def _joined(parts: Sequence[Outputs]) -> Outputs:
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}


# --- rendering and judging


def render(case: RenderCase, variant: Variant) -> Outputs:
    """All rays, the way an operation has them rendered."""
    field = copy.copy(case.field)  # its tensors are shared
    field.sampling = variant.sampling
    with use_threads(variant.threads):
        found = side_by_side(lambda tile: field.render_rays(*tile, variant.modalities, variant.geometry), case.rays.tiles(variant.tile))
        return _joined([outputs for _, outputs in found])


def difference(found: Outputs, truth: Outputs, modalities: Sequence[str]) -> dict[str, float]:
    """Of radiance, in parts of full scale: ``error`` (root mean square), ``worst``, ``psnr`` [dB, peak 1]."""
    apart = torch.cat([(found[name] - truth[name]).flatten() for name in modalities]).double().abs()
    error = float(apart.square().mean().sqrt())
    return {"error": error, "worst": float(apart.max()), "psnr": -20.0 * math.log10(max(error, 1e-12))}


def shape_difference(found: Outputs, truth: Outputs) -> dict[str, float]:
    """Of the surface: ``depth`` (median, relative), ``normal`` (median, °), ``missed``: share of rays of which one met it, one did not."""
    met = torch.isfinite(found["depth"]), torch.isfinite(truth["depth"])
    both = met[0] & met[1]
    out = {"missed": float((met[0] != met[1]).double().mean())}
    if not both.any():
        return out
    depth, true = found["depth"][both].double(), truth["depth"][both].double()
    a, b = found["normal"][both].double(), truth["normal"][both].double()
    turned = torch.atan2(torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=1), (a * b).sum(1))
    return out | {"depth": float(((depth - true).abs() / true).median()), "normal": float(torch.rad2deg(turned).median())}


def judge(case: RenderCase, variant: Variant, found: Outputs) -> dict[str, float]:
    """Radiance of what was rendered; depth, normals and samples per ray of its rays, whether they were asked for or not."""
    whole = render(case, dataclasses.replace(variant, modalities=[], geometry=True))
    radiance = difference(found, case.truth.outputs, variant.modalities) if variant.modalities else {}
    return radiance | shape_difference(whole, case.truth.outputs) | {"samples": _samples(case, variant)}


@torch.no_grad()
def _samples(case: RenderCase, variant: Variant) -> float:
    field, total = case.field, 0
    for origins, directions, _ in case.rays.tiles(TILE):
        total += int(field.trace(origins, directions, variant.sampling).samples)
    return total / len(case.rays)


# --- families


def _variants(case: RenderCase, variants: Mapping[str, Mapping[str, Any]]) -> list[Variant]:
    """For one modality and for all, one of each name, which differs from the field's own way by some figures."""
    own = {"sampling": case.field.sampling}
    return [Variant(problem, name, names, **{**own, **change}) for problem, names in case.sets.items() for name, change in variants.items()]


def _values(sampling: Sampling, key: str, values: Sequence[float]) -> dict[str, dict[str, Sampling]]:
    """Samplings with these values of a figure, and with its own."""
    own = getattr(sampling, key)
    return {f"{key} {v:g}{_own(v == own)}": {"sampling": sampling._replace(**{key: v})} for v in sorted({*values, own})}


def _own(yes: bool) -> str:
    return " (the field's)" if yes else ""


def termination(case: RenderCase) -> list[Variant]:
    """The optical depth at which a ray ends."""
    return _variants(case, _values(case.field.sampling, "max_optical_depth", (1.0, 2.0, 3.0, 5.0, 8.0)))


def steps(case: RenderCase) -> list[Variant]:
    """How a ray is sampled: the step at the surface, the stride towards it, and how much a section weighs that has its own appearance."""
    s = case.field.sampling
    lengths = {f"step x {v:g}{_own(v == 1.0)}": {"sampling": s._replace(step=v * s.step)} for v in (0.5, 1.0, 2.0, 4.0)}
    strides, weights = _values(s, "sphere_step_factor", (0.4, 0.7, 0.9)), _values(s, "min_section_weight", (0.0, 1e-2, 5e-2))
    return _variants(case, lengths | strides | weights)


def asked(case: RenderCase) -> list[Variant]:
    """What is asked for: each modality alone and all of them, with normals and without, and the surface alone; depth comes with all."""
    s, names = case.field.sampling, list(case.field.sensors)
    sets = {name: [name] for name in names} | case.sets | {"depth": []}
    return [
        Variant("all rays", f"{name}{', normals' * shape}", chosen, s, shape) for name, chosen in sets.items() for shape in (False, True)
    ]


def tiles(case: RenderCase) -> list[Variant]:
    """Rays per tile."""
    return _variants(case, {f"{size} rays{_own(size == TILE)}": {"tile": size} for size in (1024, 4096, 8192, 16384, 65536)})


def threads(case: RenderCase) -> list[Variant]:
    """Threads, from one to as many as kernels have here, by doubling."""
    most = kernel_threads()
    counts = sorted({*(2**i for i in range(most.bit_length()) if 2**i <= most), most})
    return _variants(case, {f"{n} threads": {"threads": n} for n in counts})


FAMILIES = (termination, steps, asked, tiles, threads)


# --- the bench


def bench_render(
    field: Field,
    scene: Scene,
    out: Path,
    only: Sequence[str] | None = None,
    threads: int | None = None,
    repeats: int = REPEATS,
    progress: Progress | None = None,
) -> Report:
    """Run all families, or those named in ``only``.

    Args:
        scene: whose views are rendered. threads: of torch and kernels; None: as they are. repeats: of each timing.
    Raises:
        InputError: an unknown name, a scene without frames, more threads than cores, or ``out`` cannot be written.
    """
    families = chosen_families(FAMILIES, "render", only)
    with use_threads(threads):
        machine = measure()
        rays = rays_of(field, scene)
        case = RenderCase(field, rays, truth_of(field, rays))
        methods = {name: [_method(case, variant) for variant in family(case)] for name, family in families.items()}
        rows = measured(methods, repeats, progress, torch.get_num_threads())
    for row in rows:
        row["rays_per_s"] = 1e9 / row["ns"]
    results = {
        "bench": "render",
        "machine": machine,
        "rows": rows,
        "repeats": repeats,
        "rays": len(rays),
        "sampling": field.sampling._asdict(),
        "reference": fine(field.sampling)._asdict() | {"samples": case.truth.samples, "truth_error": case.truth.error},
    }
    figure = scatter_panels(rows, ("rays_per_s", "rays/s"), ("error", "error of radiance [full scale]"), "{problem}: {method}")
    columns = (
        *numbers("", {"of": "problem", "rendered": "method"}),
        *numbers(",.0f", {"rays/s": "rays_per_s", "ns": "ns", "CPU ns": "cpu_ns"}),
        Column("samples", "samples", ".1f"),
        Column("PSNR [dB]", "psnr", ".2f"),
        Column("error", "error", ".3%"),
        Column("worst", "worst", ".1%"),
        Column("depth", "depth", ".1e"),
        Column("missed", "missed", ".3%"),
        Column("normals [°]", "normal", ".2f"),
    )
    note = (
        f" {len(rays):,} rays, the median of {repeats} turns; CPU ns: of all threads. Error and worst: of radiance, of full scale, against "
        f"{case.truth.samples:.0f} samples a ray, which is {case.truth.error:.3%} from half as many. Depth: median, relative. Missed: rays "
        "of which one met the surface and one did not."
    )
    return write_report(results, family_tables(rows, FAMILIES, columns, note), figure, out)


def _method(case: RenderCase, variant: Variant) -> Method:
    run, judged = functools.partial(render, case, variant), functools.partial(judge, case, variant)
    return Method(variant.problem, variant.name, run, judged, len(case.rays), "full scale")
