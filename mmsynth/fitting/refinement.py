"""Refinement of poses: whether it is worth it, then Gauss-Newton steps between the steps of the fit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.field.design import Corrections
from mmsynth.field.field import Field
from mmsynth.fitting import motions as poses
from mmsynth.fitting.choices import Choice, switch
from mmsynth.fitting.measurements import Batch, Measurements
from mmsynth.fitting.motions import Motions, NormalEquations, RayJacobian, Saved
from mmsynth.fitting.recipe import PosesRecipe
from mmsynth.parallel import tile_by_tile
from mmsynth.scene.scene import Scene

AT_ONCE = 1024  # rays of a batch: all that it goes through is kept for the way back
_DECIDE = 32  # batches at least, by which it is decided
_PER_STEP, _PER_VIEW = 4096, 64  # rays of a step at least
_PER_FIT, _SHARE = 400_000, 0.1  # rays of a fit's looks, where each moves cameras, or as a share of its own rays: the larger
PRIOR = 3.0  # footprints that a camera may be off, a standard deviation

Looks = Callable[[dict[str, int], int, np.random.Generator], Iterable[RayJacobian]]


@dataclass(frozen=True)
class MotionDecisions:
    """Whether views move, and sensors on the rig."""

    views: Choice[bool]
    rig: Choice[bool]

    @property
    def any(self) -> bool:
        return self.views.value or self.rig.value


def ray_residuals(
    field: Field, batches: Iterable[Batch], gain_of: Callable[[Batch], Tensor | None], far_light: bool, sampling: kernels.Sampling
) -> Iterator[RayJacobian]:
    """Residuals of rays, the mean over what was measured along each, in units of the modality's level, and their derivatives; batches side
    by side.

    Args:
        gain_of: (M,) factors of what is predicted of a batch, None: 1.
        far_light: whether light from beyond the region is seen.
    """
    field.requires_grad_(False)  # rays alone: tables would gather gradients that the next step of the fit takes for its own
    try:
        of_batch = lambda batch: _residuals(field, batch, gain_of(batch), far_light, sampling)
        yield from (rows for _, rows in tile_by_tile(field.device, of_batch, batches))
    finally:
        field.requires_grad_(True)


@torch.enable_grad()
def _residuals(field: Field, batch: Batch, gain: Tensor | None, far_light: bool, sampling: kernels.Sampling) -> RayJacobian:
    origins, directions = (x.detach().requires_grad_() for x in (batch.origins, batch.directions))
    hits = field.trace(origins, directions, sampling)
    shaded, ray = field.with_far_light(hits) if far_light else hits, kernels.rays_of(hits.behind, len(hits.share))
    outputs = field.shader(shaded.features, directions[ray], batch.per_ray(field.view_dependence)[ray])
    predicted = kernels.predict(outputs, shaded.share, batch.measured, hits.behind)
    predicted = predicted + field.mirrored(hits, origins, directions, batch.measured, sampling.active_surface)
    relative = kernels.residual(predicted if gain is None else predicted * gain, batch.measured) / batch.measured.level
    mean = origins.new_zeros(len(origins)).index_add(0, batch.measured.ray, relative) / torch.bincount(
        batch.measured.ray, minlength=len(origins)
    )
    gradients = torch.autograd.grad(mean.sum(), (origins, directions))  # rays know nothing of each other
    frame = batch.measured.ray.new_zeros(len(origins)).scatter(0, batch.measured.ray, batch.frame)
    return RayJacobian(frame.cpu(), *(x.detach().cpu().double() for x in (mean, *gradients, batch.directions)))


def rays_of_batch(measurements: Measurements) -> dict[str, int]:
    """``AT_ONCE`` rays, or a few more: of each modality as many as it has frames."""
    frames = sum(len(m.origins) for m in measurements.values())
    return {n: -(-AT_ONCE * len(m.origins) // frames) for n, m in measurements.items()}


def put(measurements: Measurements, layout: poses.Layout, motions: Motions) -> np.ndarray:
    """Let frames be where motions of their views and sensors put them: (F, 4, 4), see ``motions.moved``."""
    now = poses.moved(layout, motions)
    for s, name in enumerate(layout.sensors):
        measurements.set_poses(name, now[layout.sensor == s])
    return now


class Refinement:
    """Motions of views and sensors, and whether they have any.

    ``decided`` is None until the evidence is in. A step sees some rays of every frame and moves the cameras; the field learns on
    from where they are then. What rays said that was not enough for a step (``unsure``) counts in the next, which waits as long as looks
    were in vain.

    Args:
        footprint: of a pixel, in radii. rays: of the fit, which looks take a share of.
    """

    def __init__(self, scene: Scene, measurements: Measurements, recipe: PosesRecipe, footprint: float, rays: float, seed: int) -> None:
        self.per_fit = max(_PER_FIT, _SHARE * rays)
        self.measurements, self.recipe, self.prior, self.seed = measurements, recipe, PRIOR * footprint, seed
        frames = [f for n in measurements.order for f in scene.frames_of(n, scene.split.train)]
        self.region = scene.region
        self.layout = poses.layout_of(frames, tuple(measurements), scene.region)
        self.motions = Motions(np.zeros((len(self.layout.views), 6)), np.zeros((len(self.layout.sensors), 6)))
        self.decided: MotionDecisions | None = None
        self.unsure: NormalEquations | None = None
        self.steps, self.next = 0, recipe.start_at
        self.views_can = recipe.views != "off" and len(self.layout.views) > 1
        self.rig_can = recipe.rig != "off" and int(self.layout.free.sum()) > 1
        if not self.views_can and not self.rig_can:
            self.decided = self._decisions(False, False, "", "")

    @property
    def choices(self) -> dict[str, Choice[Any]]:
        return {} if self.decided is None else {"poses": self.decided.views, "rig": self.decided.rig}

    def due(self, progress: float) -> bool:
        """Whether it is time for a step, or to decide."""
        return (self.decided is None or self.decided.any) and progress >= self.next

    def step(self, looks: Looks, progress: float) -> None:
        """Decide, if that is not done, and move the cameras by what rays of all frames say.

        Args:
            looks: at rays of the present field, a number of each modality, so many times: their residuals and derivatives.
        """
        random = np.random.default_rng((self.seed, 3, self.steps))
        rays = max(_PER_STEP, _PER_VIEW * len(self.layout.views))
        count = -(-rays // AT_ONCE) if self.decided is not None else max(_DECIDE, -(-rays // AT_ONCE))
        equations = poses.normal_equations(looks(rays_of_batch(self.measurements), count, random), poses.moved(self.layout, self.motions))
        self.steps += 1
        self.next = progress + rays / self.per_fit
        if not equations.usable:
            return
        if self.decided is None:
            self.decided = self._decide(equations)
        if not self.decided.any:
            return
        views, rig = self.decided.views.value, self.decided.rig.value
        if self.unsure is not None:
            equations = self.unsure.and_of(equations)
        step, _ = poses.cross_validated_step(equations, self.layout, self.motions, views, rig, self.prior)
        self.unsure = None if step.views.any() or step.sensors.any() else equations
        if self.unsure is not None:  # looks in vain cost as much as others: the more there were, the later the next
            self.next = progress + max(rays, float(self.unsure.weight.sum())) / self.per_fit
            return
        self.motions = poses.advance(self.layout, self.motions, poses.fix_reference(self.layout, step, views))
        put(self.measurements, self.layout, self.motions)

    def _decide(self, equations: NormalEquations) -> MotionDecisions:
        """By the share of the error of rays not learned from that motions of views save beyond those of sensors, and the reverse."""

        def saved(views: bool, rig: bool) -> np.ndarray:
            if not views and not rig:
                return np.zeros(len(self.layout.view))
            return poses.cross_validated_step(equations, self.layout, self.motions, views, rig, self.prior)[1].frames

        def worth(frames: np.ndarray) -> bool:
            found = Saved(frames)
            return found.share > max(self.recipe.min_improvement, poses.SURE * found.unsure)

        by_views, by_rig, by_both = saved(self.views_can, False), saved(False, self.rig_can), saved(self.views_can, self.rig_can)
        views, rig = worth(by_both - by_rig), worth(by_both - by_views)
        if not views and not rig and (worth(by_views) or worth(by_rig)):
            views = bool(by_views.sum() > by_rig.sum())
            rig = not views  # one does as well as the other
        why = "motions of {} would save {:.1%} (±{:.1%}) of the error of rays not learned from, and cost {:.0e} rays of the fit"
        of_views, of_rig = (
            why.format(what, by.share, by.unsure, self.per_fit) for what, by in (("views", Saved(by_views)), ("sensors", Saved(by_rig)))
        )
        return self._decisions(views, rig, of_views, of_rig)

    def _decisions(self, views: bool, rig: bool, of_views: str, of_rig: str) -> MotionDecisions:
        """What residuals want, and why, put to what the recipe wants and the scene allows."""

        def decision(asked: str, can: bool, wanted: bool, why: str) -> Choice[bool]:
            if asked == "off":
                return switch(False, "asked for by the recipe")
            if asked == "on" and can:
                return switch(True, f"asked for by the recipe; {why}")
            return switch(can and wanted, why)

        return MotionDecisions(
            decision(self.recipe.views, self.views_can, views, of_views if self.views_can else "there is one view"),
            decision(self.recipe.rig, self.rig_can, rig, of_rig if self.rig_can else "no two sensors share views"),
        )

    def corrections(self) -> Corrections:
        """The motions in the scene's frame and unit; those of sensors and views that have none are left out."""
        layout, radius = self.layout, self.region.radius
        centre = np.array(self.region.centre)
        in_world = poses.in_world(layout, self.motions)
        # x_world = radius x + centre, so x → R x + t there is x_world → R x_world + radius t + centre - R centre
        in_world[:, :3, 3] = radius * in_world[:, :3, 3] + centre - in_world[:, :3, :3] @ centre
        in_sensor = poses.motion_to_matrix(self.motions.sensors)
        in_sensor[:, :3, 3] *= radius
        views = {v: matrix for v, matrix, m in zip(layout.views, in_world, self.motions.views, strict=True) if m.any()}
        sensors = {n: matrix for n, matrix, m in zip(layout.sensors, in_sensor, self.motions.sensors, strict=True) if m.any()}
        return Corrections(views, sensors)

    def sizes(self) -> dict[str, dict[str, dict[str, float]]]:
        """How far each view (by id) and sensor (by name) was moved: degrees, length (scene unit), pixels (of the region's picture)."""
        layout, motions = self.layout, self.motions

        def size(motion: np.ndarray, metric: np.ndarray) -> dict[str, float]:
            degrees, length = np.degrees(np.linalg.norm(motion[:3])), np.linalg.norm(motion[3:]) * self.region.radius
            return {"degrees": float(degrees), "length": float(length), "pixels": float(np.sqrt(motion @ metric @ motion))}

        views = zip(layout.views, motions.views, layout.pixels[layout.anchor], strict=True)
        sensors = (
            (n, m, layout.pixels[layout.sensor == s].mean(0)) for s, (n, m) in enumerate(zip(layout.sensors, motions.sensors, strict=True))
        )
        return {kind: {str(n): size(m, p) for n, m, p in named if m.any()} for kind, named in (("views", views), ("sensors", sensors))}

    def state_dict(self) -> dict[str, Any]:
        views, sensors = torch.from_numpy(self.motions.views), torch.from_numpy(self.motions.sensors)
        decided = None if self.decided is None else asdict(self.decided)
        unsure = None if self.unsure is None else [torch.from_numpy(part) for part in self.unsure.parts]
        return {"views": views, "sensors": sensors, "decided": decided, "unsure": unsure, "steps": self.steps, "next": self.next}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.motions = Motions(state["views"].numpy(), state["sensors"].numpy())
        self.decided = TypeAdapter(MotionDecisions | None).validate_python(state["decided"])
        self.unsure = None if state["unsure"] is None else NormalEquations(*(part.numpy() for part in state["unsure"]))
        self.steps, self.next = state["steps"], state["next"]
        if self.steps:
            put(self.measurements, self.layout, self.motions)
