"""The compact trainer: random rays of every modality, one field, one loss."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from mmsynth.errors import DivergedError, InputError
from mmsynth.field import kernels, rendering
from mmsynth.field.field import Field
from mmsynth.fitting import losses, probe
from mmsynth.fitting.measurements import Batch, Measurements, draw, in_order, load_measurements
from mmsynth.fitting.motions import Rows
from mmsynth.fitting.needs import Needs, assess
from mmsynth.fitting.optimiser import Adam, Average
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.refinement import Refinement, see
from mmsynth.fitting.schedule import learning_rate_factor, sampling_at, surface_rate_factor
from mmsynth.fitting.table_sizes import cells_at_surface, rows_log2
from mmsynth.scene.scene import Scene

PROBE_RAYS = 2048  # per modality
_GAINS = "exposure.log_gain"
_BAD_STEPS = 20
_AVERAGE_EVERY = 4  # steps: as good as every one of them, at a quarter of its cost


@dataclass(frozen=True)
class FitProgress:
    """One line of news: ``done`` in [0, 1], running means of loss and PSNR [dB] per modality, speeds over the fit."""

    step: int
    done: float
    elapsed: float
    loss: float
    psnr: dict[str, float]
    rays_per_s: float
    samples_per_s: float


@dataclass
class _State:
    step: int = 0
    elapsed: float = 0.0
    rays: int = 0
    rays_total: int = 0
    samples_total: int = 0
    bad_steps: int = 0
    reopened: int = 0
    tables: dict[str, Any] | None = None
    decided: dict[str, Any] | None = None


class Trainer:
    """A fit that can be stopped anywhere and goes on to the same field.

    Every random number of a step comes from (seed, step), so the only state is the parameters, the optimiser, the
    occupancy grid and the counters. With ``steps`` the schedule depends on the step alone and the result is the same
    for any interruption; with ``budget`` it follows the clock.
    """

    def __init__(self, scene: Scene, recipe: Recipe, steps: int | None, budget: float | None, seed: int, device: str) -> None:
        if (steps is None) == (budget is None):
            raise InputError("fit: give either a number of steps or a time budget, not both.")
        self.recipe, self.steps, self.budget, self.seed = recipe, steps, budget, seed
        self.device = torch.device(device)
        torch.manual_seed(seed)
        self.measurements: dict[str, Measurements] = load_measurements(scene)
        self.needs: Needs = assess(scene, self.measurements, recipe, seed, self._rays_to_come())
        sensors = {n: m.sensor for n, m in self.measurements.items()}
        radiance_scale = {n: m.level for n, m in self.measurements.items()}
        cameras = {n: m.cameras[0] for n, m in self.measurements.items()}
        self.field = Field(self.needs.design, sensors, radiance_scale, scene.region, scene.unit, cameras, rig_of(scene)).to(self.device)
        frames = sum(len(m.origins) for m in self.measurements.values())
        self.log_gain = torch.nn.Parameter(torch.zeros(frames, device=self.device))
        parameters = {**dict(self.field.named_parameters()), _GAINS: self.log_gain}
        tables = {n for n in parameters if n.endswith(".table")}
        rates = {n: recipe.learning_rate_grid if n in tables else recipe.learning_rate_network for n in parameters}
        rates[_GAINS] = recipe.learning_rate_exposure
        self.optimiser = Adam(parameters, rates)
        self.average = Average(parameters)
        self.networks = [p for n, p in parameters.items() if n not in tables]
        self.of_surface = [n for n in parameters if n.startswith("surface.")]
        self.state = _State(rays=recipe.rays_at_start)
        self.task = self._task()  # now: poses are as the input has them
        self.refinement = Refinement(scene, self.measurements, recipe, self.needs.footprint, seed)
        self.needs.evidence.update(self.refinement.evidence)
        self.has_alpha = any(m.has_alpha for m in self.measurements.values())
        self.mean_loss = math.nan
        self.mean_error: dict[str, float] = {}

    @property
    def progress(self) -> float:
        """Share of the fit that is done, in [0, 1]."""
        if self.steps is not None:
            return min(1.0, self.state.step / self.steps)
        return min(1.0, self.state.elapsed / self.budget)  # type: ignore[operator]

    def _rays_to_come(self) -> float:
        """Rays that the fit will see, about: a constant per step or second, so that the design does not depend on the clock."""
        return self.steps * self.recipe.samples_per_step / 10 if self.steps is not None else (self.budget or 0.0) * 70_000

    def run_step(self) -> None:
        """One optimiser step."""
        state, recipe, field = self.state, self.recipe, self.field
        random = np.random.default_rng((self.seed, 1, state.step))
        generator = torch.Generator().manual_seed(int(random.integers(2**62)))
        sampling = sampling_at(self.progress, recipe, self.needs)
        if state.step % recipe.occupancy_every == 0:
            share = 1.0 if state.step == 0 else 1 / 16
            sdf = lambda x: field.surface(x, sampling.active_surface)
            if not field.occupancy.update(sdf, sampling.sharpness, generator, share):
                state.reopened += 1
        if state.tables is None and 0 < recipe.tables_at <= self.progress:
            self._size_tables(sampling, generator)
        if state.decided is None:
            # a surface in the wrong place can be painted right for every view; it cannot while its colour has no direction
            seen = 0 if self.progress < recipe.view_dependence_from else probe.DEGREES
            field.view_dependence.update(dict.fromkeys(self.measurements, seen))
            if self.progress >= recipe.decide_at:
                self._decide(sampling)
        if self.refinement.due(self.progress):
            self.refinement.step(functools.partial(self._see, sampling), self.progress)
            self.needs.evidence.update(self.refinement.evidence)
        total = sum(self.needs.share.values())
        rays = {n: max(1, int(state.rays * share / total)) for n, share in self.needs.share.items()}
        batch = draw(self.measurements, field.shader.columns, rays, random, self.device)
        loss, errors, samples = self._loss(batch, sampling, generator)
        if not bool(torch.isfinite(loss)):
            self._skip("the loss is not finite")
            return
        loss.backward()
        # what is NaN in a sample is NaN in a sum
        if not bool(torch.isfinite(torch.cat([p.grad.flatten() for p in self.networks if p.grad is not None]).sum())):
            self.optimiser.clear()
            self._skip("a gradient is not finite")
            return
        slower = dict.fromkeys(self.of_surface, surface_rate_factor(sampling.sharpness, recipe))
        grids = {
            "surface.grid.table": (field.surface.grid, sampling.active_surface),
            "appearance.table": (field.appearance, sampling.active_radiance),
        }
        rows = {n: int(grid.offsets[active]) for n, (grid, active) in grids.items()}
        self.optimiser.step(learning_rate_factor(self.progress, recipe), slower, rows)
        keep = 0.98 if state.step else 0.0
        first = math.isnan(self.mean_loss)  # also after steps that were skipped
        self.mean_loss = float(loss.detach()) if first else keep * self.mean_loss + (1 - keep) * float(loss.detach())
        for name, error in errors.items():
            self.mean_error[name] = keep * self.mean_error.get(name, error) + (1 - keep) * error
        done = self.progress
        if recipe.average > 0 and done >= 1.0 - 4.0 * recipe.average and state.step % _AVERAGE_EVERY == 0:
            self.average.update(recipe.average * state.step / max(done, 1e-9) / _AVERAGE_EVERY)
        state.rays_total += len(batch.origins)
        state.samples_total += samples
        # a fixed number of samples a step; the number of rays follows, by at most a factor of two either way
        ratio = min(2.0, max(0.5, recipe.samples_per_step / max(samples, 1)))
        state.rays = int(min(65536, max(len(batch.parts), 0.5 * state.rays * (1 + ratio))))
        state.step += 1

    def _loss(self, batch: Batch, sampling: kernels.Sampling, generator: torch.Generator) -> tuple[torch.Tensor, dict[str, float], int]:
        recipe, field = self.recipe, self.field
        origins, directions = batch.origins, batch.directions
        jitter = torch.rand(len(origins), generator=generator).to(self.device)
        hits = rendering.trace(field.surface, field.appearance, field.occupancy, origins, directions, jitter, sampling)
        degrees = self._per_ray(batch, field.view_dependence)
        # a few frames would bend geometry, appearance and trunk to themselves: scarce modalities teach their own head alone
        teaches = self._per_ray(batch, {n: n not in self.needs.scarce for n in batch.parts})
        gain = self._gain_of(batch)
        # light from beyond the region would explain what is in it as long as that has no shape
        shaded = field.with_far_light(hits) if self.state.decided else (hits.features, hits.opacity)
        loss, squared = losses.compare(field.shader, *shaded, batch, degrees, teaches, gain)
        errors = {name: float(squared[numbers].mean()) for name, (_, numbers) in batch.parts.items()}
        if self.has_alpha:
            known = torch.isfinite(batch.alpha)
            loss = loss + recipe.opacity * (hits.opacity - batch.alpha)[known].square().sum() / len(origins)
        elif self.needs.black_background:
            black = torch.zeros_like(hits.opacity).scatter_reduce(0, batch.ray, batch.target / batch.level, "amax") < 0.02
            loss = loss + recipe.emptiness * (hits.opacity * black).mean()
        if recipe.eikonal > 0:
            loss = loss + recipe.eikonal * losses.eikonal(self._gradients(hits, origins, directions, sampling, generator))
        return loss, errors, int(hits.samples)

    def _gain(self) -> torch.Tensor:
        """Exposure of every frame relative to their mean."""
        return torch.exp(self.log_gain - self.log_gain.mean())

    def _gain_of(self, batch: Batch) -> torch.Tensor | None:
        """Exposure of each number's frame, (M,); None where no gains were needed."""
        return self._gain()[batch.frame] if self.state.decided and self.state.decided["exposure"] else None

    def _see(self, sampling: kernels.Sampling, rays: dict[str, int], random: np.random.Generator) -> Rows:
        batch = draw(self.measurements, self.field.shader.columns, rays, random, self.device)
        beyond = self.state.decided is not None
        return see(self.field, batch, self._per_ray(batch, self.field.view_dependence), self._gain_of(batch), beyond, sampling)

    def _per_ray(self, batch: Batch, values: dict[str, Any]) -> torch.Tensor:
        """A value for each modality → one for each ray, (R,)."""
        counts = [rays.stop - rays.start for rays, _ in batch.parts.values()]
        return torch.from_numpy(np.repeat([values[n] for n in batch.parts], counts)).to(self.device)

    def _size_tables(self, sampling: kernels.Sampling, generator: torch.Generator) -> None:
        """Give the levels of the hash tables that are not yet active rows for the cells at the surface, as it is now."""
        recipe, design = self.recipe, self.needs.design
        cells = cells_at_surface(self.field, sampling.active_surface, generator)
        names, active = ("surface", "radiance"), (sampling.active_surface, sampling.active_radiance)
        levels = recipe.surface_levels, recipe.radiance_levels
        most = int(design.surface_rows_log2), int(design.radiance_rows_log2)  # type: ignore[arg-type]
        rows = [rows_log2(n / recipe.cells_per_row, m) for n, m in zip(cells, most, strict=True)]
        evidence = ", ".join(
            f"{name} 2^{r} for {n:.2g} cells" + (" (by the rays to come or the recipe no more)" if r == m else "")
            for name, r, m, n in zip(names, rows, most, cells, strict=True)
        )
        self.state.tables = {
            **{name: [m] * a + [r] * (k - a) for name, m, r, a, k in zip(names, most, rows, active, levels, strict=True)},
            "first": list(active),
            "evidence": f"rows for each of the finer levels, cells of the finest at the surface: {evidence}",
        }
        self._resize_tables(self.state.tables, generator)

    def _resize_tables(self, sizes: dict[str, Any], generator: torch.Generator) -> None:
        kept = self.field.resize_tables(tuple(sizes["surface"]), tuple(sizes["radiance"]), tuple(sizes["first"]), generator)
        for name, rows in kept.items():
            self.optimiser.resize(name, rows)
            self.average.resize(name, rows)
        self.needs.evidence["tables"] = sizes["evidence"]

    @torch.no_grad()
    def _decide(self, sampling: kernels.Sampling) -> None:
        """Put the residuals of this moment to the tests of ``probe``, and switch on what they ask for."""
        recipe, field = self.recipe, self.field
        random = np.random.default_rng((self.seed, 2))
        batch = draw(self.measurements, field.shader.columns, dict.fromkeys(self.measurements, PROBE_RAYS), random, self.device)
        jitter = torch.full((len(batch.origins),), 0.5, device=self.device)
        hits = rendering.trace(field.surface, field.appearance, field.occupancy, batch.origins, batch.directions, jitter, sampling)
        outputs = field.shader(hits.features, batch.directions, self._per_ray(batch, field.view_dependence))
        predicted = kernels.predict(outputs, hits.opacity, batch.measured)
        evidence = self.needs.evidence
        degrees, spreads, begin = {}, {}, 0
        usable = batch.target < batch.saturation
        errors = probe.errors_by_degree(field.shader, hits.features, hits.opacity, batch) if recipe.view_dependence == "auto" else {}
        for name, (_, numbers) in batch.parts.items():
            if recipe.view_dependence == "auto":
                degree = probe.degree_needed(errors[name], recipe.view_dependence_worth)
                best = errors[name][-1]
                grown = ", ".join(f"{e / best - 1:+.1%}" for e in errors[name][:-1]) if best > 0 else "nothing that could be told apart"
                evidence[f"view_dependence.{name}"] = f"degree {degree}: error with degree 0, 1, 2 in place of 3: {grown}"
            else:
                degree = recipe.view_dependence
                evidence[f"view_dependence.{name}"] = f"degree {degree}: asked for by the recipe"
            degrees[name] = degree
            level, frames = field.radiance_scale[name], len(self.measurements[name].origins)
            rows = [x[numbers][usable[numbers]].cpu().numpy() for x in (predicted / level, batch.target / level, batch.frame)]
            spread, noise = probe.exposure_spread(probe.Residuals(rows[0], rows[1], rows[2] - begin), frames)
            begin += frames
            spreads[name] = spread if spread > 2 * noise / math.sqrt(max(frames, 1)) else 0.0
        why = ", ".join(f"{n} {s:.1%}" for n, s in spreads.items())
        asked = recipe.exposure != "auto"
        exposure = recipe.exposure == "on" if asked else max(spreads.values()) > recipe.exposure_worth
        evidence["exposure"] = (
            f"{'on' if exposure else 'off'}: {'asked for by the recipe; ' if asked else ''}exposure differs between frames by {why}"
        )
        field.view_dependence.update(degrees)
        self.state.decided = {"view_dependence": degrees, "exposure": exposure, "evidence": dict(evidence)}

    def _gradients(
        self,
        hits: kernels.Hits,
        origins: torch.Tensor,
        directions: torch.Tensor,
        sampling: kernels.Sampling,
        generator: torch.Generator,
    ) -> torch.Tensor:
        """∇sdf around some of the hits, within the soft surface, and at some points of the whole region."""
        count = self.recipe.eikonal_points
        extent = self.field.surface.grid.extent
        points = [((torch.rand(count // 4, 3, generator=generator) * 2 - 1) * extent).to(self.device)]
        hit = torch.nonzero(torch.isfinite(hits.depth))[:, 0]
        if len(hit):
            chosen = hit[torch.randint(len(hit), (count - len(points[0]),), generator=generator).to(self.device)]
            noise = torch.randn(len(chosen), 3, generator=generator).to(self.device) * (3.0 / sampling.sharpness)
            at = origins[chosen] + directions[chosen] * hits.depth[chosen, None]
            points.append(self.field.surface.grid.to_grid(at) + noise)
        epsilon = self.field.surface.grid.cell(sampling.active_surface)
        return self.field.surface.gradient(torch.cat(points), epsilon, sampling.active_surface)

    def _skip(self, reason: str) -> None:
        self.state.step += 1
        self.state.bad_steps += 1
        if self.state.bad_steps >= _BAD_STEPS:
            raise DivergedError(f"fit: {reason} in {self.state.bad_steps} steps (last: step {self.state.step}); the checkpoint is kept.")

    def gains(self) -> dict[str, list[float]]:
        """Exposure of each training frame relative to the mean, per modality; empty when no gains were needed."""
        if not self.state.decided or not self.state.decided["exposure"]:
            return {}
        order = in_order(self.measurements)
        parts = self._gain().detach().cpu().split([len(self.measurements[n].origins) for n in order])
        return {n: part.tolist() for n, part in zip(order, parts, strict=True)}

    def report(self) -> FitProgress:
        """News for a progress bar."""
        s = self.state
        psnr = {n: -10 * math.log10(max(e, 1e-12)) for n, e in self.mean_error.items()}
        rate = 1.0 / max(s.elapsed, 1e-9)
        return FitProgress(s.step, self.progress, s.elapsed, self.mean_loss, psnr, s.rays_total * rate, s.samples_total * rate)

    def checkpoint(self) -> dict[str, Any]:
        """All state, as tensors and numbers."""
        return {
            "version": 1,
            "task": self.task,
            "field": self.field.state_dict(),
            "log_gain": self.log_gain.detach(),
            "optimiser": self.optimiser.state_dict(),
            "average": self.average.state_dict(),
            "refinement": self.refinement.state_dict(),
            "state": vars(self.state).copy(),
            "mean_loss": self.mean_loss,
            "mean_error": dict(self.mean_error),
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up a checkpoint.

        Raises:
            InputError: it belongs to another scene, recipe, seed or length.
        """
        ours, theirs = self.task, saved["task"]
        for key, value in ours.items():
            if theirs.get(key) != value:
                raise InputError(
                    f"checkpoint: was made with {key} {theirs.get(key)}, this fit has {value}; give another --run or the same options."
                )
        self.state = _State(**saved["state"])
        if self.state.tables is not None:
            self._resize_tables(self.state.tables, torch.Generator())  # what is new is read from the checkpoint
        self.field.load_state_dict(saved["field"])
        self.optimiser.load_state_dict(saved["optimiser"])
        self.log_gain.data.copy_(saved["log_gain"])
        self.average.load_state_dict(saved["average"])
        self.refinement.load_state_dict(saved["refinement"])
        self.needs.evidence.update(self.refinement.evidence)
        if self.state.decided is not None:
            self.field.view_dependence.update(self.state.decided["view_dependence"])
            self.needs.evidence.update(self.state.decided["evidence"])
        self.mean_loss, self.mean_error = saved["mean_loss"], dict(saved["mean_error"])

    def _task(self) -> dict[str, Any]:
        """What a checkpoint must agree on to be resumed: hash of the pixels and poses, recipe, seed, length."""
        digest = hashlib.sha256()
        for name, m in self.measurements.items():
            digest.update(name.encode())
            for part in (m.origins, m.rotations, m.values):
                digest.update(np.ascontiguousarray(part).tobytes())
        return {
            "scene": digest.hexdigest()[:16],
            "recipe": json.dumps(self.recipe.model_dump(), sort_keys=True),
            "seed": self.seed,
            "steps": self.steps or 0,
            "budget": self.budget or 0.0,
        }


def rig_of(scene: Scene) -> dict[str, np.ndarray]:
    """sensor → (4, 4) sensor_to_reference, from the first view that both saw; sensors that never shared a view are left out."""
    reference = next(iter(scene.sensors))
    poses = {f.view: f.camera_to_world for f in scene.frames_of(reference)}
    rig = {reference: np.eye(4)}
    for name in scene.sensors:
        for frame in scene.frames_of(name):
            if name != reference and frame.view in poses:
                rig[name] = np.linalg.inv(poses[frame.view]) @ frame.camera_to_world
                break
    return rig
