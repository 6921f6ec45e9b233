"""Do surfaces of this scene mirror lamps? Residuals of a field say where lamps may be, and after a trial whether they are needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.field import MIRROR_CELLS, Field
from mmsynth.field.light import find_lamps
from mmsynth.fitting.candidates import errors_of_copies, look, look_twice
from mmsynth.fitting.choices import Choice, switch
from mmsynth.fitting.measurements import Batch, Measurements, draw
from mmsynth.fitting.needs import DEGREES, Needs
from mmsynth.fitting.recipe import RadianceRecipe

_RAYS = 4096  # per modality
_SURE = 2.0  # standard errors of what lamps save
_FARTHER = 2.0  # than the cameras: where lamps are looked for first
_FAINT = 0.01  # of the power of all mirrored light: a lamp that was not there, or that another one has taken the place of
_BRIGHTEST = 3.0  # times the typical value: what is brighter does not say more


@dataclass(frozen=True)
class _Look:
    """Rays of all modalities and the surfaces that they met, H of them: points, normals and the rays' directions (H, 3)."""

    batch: Batch
    hits: kernels.Hits
    points: Tensor
    normals: Tensor
    directions: Tensor


@torch.no_grad()
def _look(field: Field, measurements: Measurements, sampling: kernels.Sampling, seed: int) -> _Look:
    random = np.random.default_rng((seed, 9))
    batch = draw(measurements, field.shader.columns, dict.fromkeys(measurements, _RAYS), random)
    hits = field.trace(batch.origins, batch.directions, sampling)
    ray = kernels.rays_of(hits.behind, len(hits.share))
    points = batch.origins[ray] + batch.directions[ray] * hits.distance[:, None]
    normals = field.normals(points, field.slopes(points, sampling.active_surface, MIRROR_CELLS))
    return _Look(batch, hits, points, normals, batch.directions[ray])


@torch.no_grad()
def look_for_lamps(field: Field, measurements: Measurements, sampling: kernels.Sampling, seed: int) -> int:
    """Put lamps into a field's light where mirrored rays are brighter than their surfaces, and than its lamps so far make them: how many.

    The directions are those of ``find_lamps``, the distance is a guess that the fit improves. Not for once: while surfaces are not yet
    in shape, some are missed, and others seen where none are. So lamps of which next to nothing is seen are given up first.
    """
    light = field.light
    if light is None:
        return 0
    if field.shines:
        keep_bright_lamps(field, measurements, sampling, seed)
    look = _look(field, measurements, sampling, seed)
    batch, hits, rays = look.batch, look.hits, len(look.batch.origins)
    m = batch.measured
    # what the shader paints for some directions alone may be a lamp's, too
    paint = kernels.predict(field.shader(hits.features, look.directions, 0), hits.share, m, hits.behind)
    seen = field.mirrored(hits, batch.origins, batch.directions, m, sampling.active_surface)
    chosen = (hits.share[:rays] > 0.5) & (torch.linalg.vector_norm(look.points[:rays], dim=-1) < 1.0)

    def least(more: Tensor) -> Tensor:
        """A lamp is brighter in every number of a ray."""
        of_rays = torch.zeros_like(hits.opacity).scatter_reduce(0, m.ray, more / m.level, "amin", include_self=False)
        return of_rays.clamp(0.0, _BRIGHTEST)[chosen]

    d, n = batch.directions[chosen], look.normals[:rays][chosen]
    reflected, known = d - 2.0 * (d * n).sum(-1, keepdim=True) * n, light.position[light.used]
    distance = torch.linalg.vector_norm(known, dim=-1, keepdim=True)
    lamps = find_lamps(reflected, least(m.target - paint), least(m.target - paint - seen), known / distance)
    cameras = np.concatenate([np.linalg.norm(m.origins, axis=1) for m in measurements.values()])
    light.add(lamps * (float(distance.mean()) if len(known) else _FARTHER * max(float(np.median(cameras)), 1.0)))
    return len(lamps)


def decide_light(
    field: Field,
    measurements: Measurements,
    selected: tuple[kernels.Selection, kernels.Selection],
    recipe: RadianceRecipe,
    needs: Needs,
    sampling: kernels.Sampling,
    seed: int,
) -> Choice[bool]:
    """Whether the lamps of a field that has learned with them are worth it.

    Two copies of the shader learn on, one of them without the lamps, and are compared: see ``candidates``. The modality counts that lamps
    save most of: of few full-size views, that is the one behind analysers. They cost time; few views run out before it does, and are given
    lamps that save anything beyond doubt: what the shader paints in their place is wrong between the views.

    ``selected``: the pixels that copies learn from, and those that judge, see ``held_out``.
    """
    if recipe.light == "off":
        return switch(False, "asked for by the recipe")
    if not field.shines:
        return switch(False, "from no direction surfaces are brighter than from others")
    random = np.random.default_rng((seed, 10))
    learned, judged = look_twice(field, measurements, selected, sampling, random)
    errors = errors_of_copies(field.shader, learned, judged, [(DEGREES, True), (DEGREES, False)])
    of_each = {name: _saved(*own) for name, own in errors.items()}
    modality = max(of_each, key=lambda name: of_each[name][0])
    saved, unsure = of_each[modality]
    lamps = keep_bright_lamps(field, measurements, sampling, seed)
    why = f"{lamps} lamps, mirrored, save {saved:.1%} (±{unsure:.1%}) of {modality}'s error at rays not learned from"
    if recipe.light == "on":
        return switch(True, f"asked for by the recipe; {why}")
    worth = max(0.0 if needs.few else recipe.light_min_improvement, _SURE * unsure)
    return switch(saved > worth, f"{why}; costs a normal for each surface met" if saved > worth else f"{why}, {worth:.1%} asked for")


def _saved(lit: Tensor, unlit: Tensor) -> tuple[float, float]:
    """What lamps save of the mean of errors (N,), N = 0 allowed, and the standard error of that."""
    whole = float(unlit.mean()) if len(unlit) else 0.0
    if whole == 0:
        return 0.0, 0.0
    kept = float(lit.mean()) / whole
    return 1.0 - kept, float((kept * unlit - lit).std()) / len(lit) ** 0.5 / whole  # of a ratio (Cochran 1977, ch. 6)


@torch.no_grad()
def keep_bright_lamps(field: Field, measurements: Measurements, sampling: kernels.Sampling, seed: int) -> int:
    """Give up the lamps of which surfaces mirror next to nothing: how many are left."""
    seen = look(field, measurements, _RAYS // 2, sampling, np.random.default_rng((seed, 11)))
    light, batch = field.light, seen.batch
    assert light is not None
    power, used = torch.zeros(len(light.used), device=field.device), light.used.clone()
    for k in torch.nonzero(used)[:, 0] if light.count > 1 else ():
        light.used[k] = False
        others = field.mirrored(seen.hits, batch.origins, batch.directions, batch.measured, sampling.active_surface)
        light.used[k] = True
        power[k] = ((seen.mirrored - others) / batch.measured.level).square().mean()
    light.used.copy_(used & (power >= _FAINT * power.sum()))
    return light.count
