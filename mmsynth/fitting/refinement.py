"""Whether and when poses are refined: decided by evidence, then Gauss-Newton steps between the steps of the fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mmsynth.field import kernels, rendering
from mmsynth.field.field import Corrections, Field
from mmsynth.fitting import motions as poses
from mmsynth.fitting.measurements import Batch, Measurements, in_order
from mmsynth.fitting.motions import Equations, Motions, Rows
from mmsynth.fitting.recipe import Recipe
from mmsynth.scene.scene import Scene

_AT_ONCE = 4096  # rays of a batch
_DECIDE = 8  # batches at least, by which it is decided
_PER_VIEW = 64  # rays of a step at least
_PER_FIT = 400_000  # rays from the beginning to the end of a fit
_PRIOR = 3.0  # footprints that a camera may be off, a standard deviation

See = Callable[[dict[str, int], np.random.Generator], Rows]


def see(field: Field, batch: Batch, degrees: Tensor, gain: Tensor | None, beyond: bool, sampling: kernels.Sampling) -> Rows:
    """Residuals of rays, the mean over the numbers measured along each, in units of the modality's level, and their derivatives.

    Args:
        degrees: (R,) of the harmonics of direction. gain: (M,) factors of the predicted numbers, None: 1.
        beyond: whether light from beyond the region is seen.
    """
    origins, directions = (x.detach().requires_grad_() for x in (batch.origins, batch.directions))
    middle = torch.full((len(origins),), 0.5, device=origins.device)
    field.requires_grad_(False)  # rays alone: tables would gather gradients that the next step of the fit takes for its own
    with torch.enable_grad():
        hits = rendering.trace(field.surface, field.appearance, field.occupancy, origins, directions, middle, sampling)
        features, opacity = field.with_far_light(hits) if beyond else (hits.features, hits.opacity)
        predicted = kernels.predict(field.shader(features, directions, degrees), opacity, batch.measured)
        relative = kernels.residual(predicted if gain is None else predicted * gain, batch.measured) / batch.level
        mean = torch.zeros_like(middle).index_add(0, batch.ray, relative) / torch.bincount(batch.ray, minlength=len(origins))
        gradients = torch.autograd.grad(mean.sum(), (origins, directions))  # rays know nothing of each other
    field.requires_grad_(True)
    frame = batch.ray.new_zeros(len(origins)).scatter(0, batch.ray, batch.frame)
    return Rows(frame.cpu(), *(x.detach().cpu().double() for x in (mean, *gradients, batch.directions)))


class Refinement:
    """Motions of views and sensors, and whether they have any.

    ``decided`` is None until the evidence is in. A step sees some rays of every frame and moves the cameras; the field learns on
    from where they are then.
    """

    def __init__(self, scene: Scene, measurements: dict[str, Measurements], recipe: Recipe, footprint: float, seed: int) -> None:
        self.measurements, self.recipe, self.prior, self.seed = measurements, recipe, _PRIOR * footprint, seed
        frames = [f for n in in_order(measurements) for f in scene.frames_of(n, scene.split.train)]
        self.region = scene.region
        self.layout = poses.layout_of(frames, tuple(measurements), scene.region)
        self.motions = Motions(np.zeros((len(self.layout.views), 6)), np.zeros((len(self.layout.sensors), 6)))
        self.decided: dict[str, bool] | None = None
        self.evidence: dict[str, str] = {}
        self.steps, self.next = 0, recipe.poses_at
        self.possible = {
            "poses": recipe.poses != "off" and len(self.layout.views) > 1,
            "rig": recipe.rig != "off" and int(self.layout.free.sum()) > 1,
        }
        if not any(self.possible.values()):
            self._settle({}, {})

    def due(self, progress: float) -> bool:
        """Whether it is time for a step, or to decide."""
        return (self.decided is None or any(self.decided.values())) and progress >= self.next

    def step(self, see: See, progress: float) -> None:
        """Decide, if that is not done, and move the cameras by what rays of all frames say.

        Args:
            see: rays of the present field, a number of each modality: their residuals and derivatives.
        """
        random = np.random.default_rng((self.seed, 3, self.steps))
        rays = max(_AT_ONCE, _PER_VIEW * len(self.layout.views))
        count = -(-rays // _AT_ONCE) if self.decided is not None else max(_DECIDE, -(-rays // _AT_ONCE))
        counts = {n: -(-_AT_ONCE * len(m.origins) // len(self.layout.view)) for n, m in self.measurements.items()}
        said = poses.equations((see(counts, random) for _ in range(count)), poses.moved(self.layout, self.motions))
        self.steps += 1
        self.next = progress + rays / _PER_FIT
        if not np.isfinite(said.matrix).all() or not said.error.sum() > 0:
            return  # nothing can be said now
        if self.decided is None:
            self._decide(said)
        assert self.decided is not None
        views, rig = self.decided["poses"], self.decided["rig"]
        if not views and not rig:
            return
        step, _ = poses.confirmed(said, self.layout, self.motions, views, rig, self.prior)
        self.motions = poses.advance(self.layout, self.motions, poses.on_the_rig(self.layout, step, views))
        self._place()

    def _decide(self, said: Equations) -> None:
        """By the share of the error of rays not learned from that motions of views save beyond those of sensors, and the reverse."""
        can, worth = self.possible, self.recipe.poses_worth
        views, rig, both = (
            poses.confirmed(said, self.layout, self.motions, v, r, self.prior)[1] if v or r else 0.0
            for v, r in ((can["poses"], False), (False, can["rig"]), (can["poses"], can["rig"]))
        )
        wanted = {"poses": both - rig > worth, "rig": both - views > worth}
        if not any(wanted.values()) and max(views, rig) > worth:
            wanted = {"poses": views > rig, "rig": rig >= views}  # one does as well as the other
        said_of = f"would save {{:.1%}} of the error of rays not learned from, and cost {_PER_FIT:.0e} rays of the fit"
        self._settle(wanted, {"poses": f"motions of views {said_of.format(views)}", "rig": f"motions of sensors {said_of.format(rig)}"})

    def _settle(self, wanted: dict[str, bool], why: dict[str, str]) -> None:
        self.decided = {}
        cannot = {"poses": "there is one view", "rig": "no two sensors share views"}
        for what, asked in (("poses", self.recipe.poses), ("rig", self.recipe.rig)):
            on = self.possible[what] and (asked == "on" or wanted[what])
            self.decided[what] = on
            reason = why[what] if self.possible[what] else cannot[what]
            if asked == "off" or (asked == "on" and on):
                reason = "asked for by the recipe" if asked == "off" else f"asked for by the recipe; {reason}"
            self.evidence[what] = f"{'on' if on else 'off'}: {reason}"

    def _place(self) -> None:
        now, begin = poses.moved(self.layout, self.motions), 0
        for name in in_order(self.measurements):
            m = self.measurements[name]
            m.place(now[begin : begin + len(m.origins)])
            begin += len(m.origins)

    def corrections(self) -> Corrections:
        """The motions in the scene's frame and unit; those of sensors and views that have none are left out."""
        layout, radius = self.layout, self.region.radius
        centre = np.array(self.region.centre)
        in_world = poses.in_world(layout, self.motions)
        # x_world = radius x + centre, so x → R x + t there is x_world → R x_world + radius t + centre - R centre
        in_world[:, :3, 3] = radius * in_world[:, :3, 3] + centre - in_world[:, :3, :3] @ centre
        in_sensor = poses.rigid(self.motions.sensors)
        in_sensor[:, :3, 3] *= radius
        views = {v: matrix for v, matrix, m in zip(layout.views, in_world, self.motions.views, strict=True) if m.any()}
        sensors = {n: matrix for n, matrix, m in zip(layout.sensors, in_sensor, self.motions.sensors, strict=True) if m.any()}
        return Corrections(views, sensors)

    def sizes(self) -> dict[str, dict[str, dict[str, float]]]:
        """How far each view (by id) and sensor (by name) was moved: degrees, length (scene unit), pixels (of the region's picture)."""
        layout = self.layout
        metric = {
            "views": layout.pixels[layout.anchor],
            "sensors": np.array([layout.pixels[layout.sensor == s].mean(0) for s in range(len(layout.sensors))]),
        }
        names = {"views": layout.views, "sensors": layout.sensors}
        motions = {"views": self.motions.views, "sensors": self.motions.sensors}
        return {
            kind: {
                str(name): {
                    "degrees": float(np.degrees(np.linalg.norm(m[:3]))),
                    "length": float(np.linalg.norm(m[3:]) * self.region.radius),
                    "pixels": float(np.sqrt(m @ metric[kind][i] @ m)),
                }
                for i, (name, m) in enumerate(zip(names[kind], motions[kind], strict=True))
                if m.any()
            }
            for kind in ("views", "sensors")
        }

    def state_dict(self) -> dict[str, Any]:
        return {
            "views": torch.from_numpy(self.motions.views),
            "sensors": torch.from_numpy(self.motions.sensors),
            "decided": self.decided,
            "evidence": dict(self.evidence),
            "steps": self.steps,
            "next": self.next,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.motions = Motions(state["views"].numpy(), state["sensors"].numpy())
        self.decided, self.evidence = state["decided"], dict(state["evidence"])
        self.steps, self.next = state["steps"], state["next"]
        if self.steps:
            self._place()
