"""The compact trainer: random rays of every modality, one field, one loss.

A step, what is due before it and what is kept of a fit stand in one file: they read and write the same state.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from pydantic import TypeAdapter
from torch.nn.functional import pad

from mmsynth.errors import DivergedError, InputError
from mmsynth.field import kernels
from mmsynth.field.field import Field
from mmsynth.fitting.ahead import DrawnStep, ToDraw, drawn_step
from mmsynth.fitting.choices import Choice
from mmsynth.fitting.decisions import Decisions, decide
from mmsynth.fitting.held_out import held_out_tiles, selections
from mmsynth.fitting.importance import Importance
from mmsynth.fitting.lighting import decide_light, keep_bright_lamps, look_for_lamps
from mmsynth.fitting.measurements import Batch, Measurements, draw, drawing_of, empty_drawing_of, fingerprint, load_measurements
from mmsynth.fitting.motions import RayJacobian
from mmsynth.fitting.needs import DEGREES, Needs, assess, expected_rays
from mmsynth.fitting.optimiser import Adam, Average
from mmsynth.fitting.progress import FitProgress, FitState
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.refinement import Refinement, ray_residuals
from mmsynth.fitting.schedule import (
    is_early,
    learning_rate_factor,
    light_looks,
    samples_of_step,
    sampling_at,
    surface_beta2,
    surface_rates,
)
from mmsynth.fitting.smoothness import pairs_at, smooth
from mmsynth.fitting.stored_frames import OnLoad
from mmsynth.fitting.table_sizes import TableSizes, size_tables
from mmsynth.fitting.terms import eikonal, eikonal_points, opacities
from mmsynth.parallel import give_back
from mmsynth.scene.scene import Scene, rig_of
from mmsynth.sensors.metrics import psnr_from_mse

if TYPE_CHECKING:
    from mmsynth.fitting.device_step import DeviceStep

_GAINS = "exposure.log_gain"
_BAD_STEPS = 20
_MOST_RAYS = 65536
_OUTSIDE = 4  # rays into the masks for each that passes outside: these say little, and cost as much (measured on one scene)
_RENEW_EVERY = 16  # steps: where rays go
_MOVE_EVERY = 8  # steps at least: the field learns from where cameras are before they move again
_AVERAGE_EVERY = 4  # steps: as good as every one of them, at a quarter of its cost


class Trainer:
    """A fit that can be stopped anywhere and goes on to the same field.

    Every random number of a step comes from (seed, step), so the only state is the parameters, the optimiser, the
    occupancy grid and the counters. With ``steps`` the schedule depends on the step alone and the result is the same
    for any interruption; with ``budget`` it follows the clock.
    """

    def __init__(
        self, scene: Scene, recipe: Recipe, steps: int | None, budget: float | None, seed: int, device: str, on_load: OnLoad | None = None
    ) -> None:
        if (steps is None) == (budget is None):
            raise InputError("fit: give either a number of steps or a time budget, not both.")
        self.recipe, self.steps, self.budget, self.seed = recipe, steps, budget, seed
        self.device = torch.device(device)
        torch.manual_seed(seed)
        fused = self.device.type == "cuda" and kernels.fused_on_gpu()
        rays_to_come = expected_rays(recipe, steps, budget, fused)
        self.measurements: Measurements = load_measurements(scene, rays_to_come=rays_to_come, device=self.device, on_load=on_load)
        self.needs: Needs = assess(scene, self.measurements, recipe, seed, rays_to_come)
        sensors = {n: m.sensor for n, m in self.measurements.items()}
        radiance_scale = {n: m.radiance_scale for n, m in self.measurements.items()}
        cameras = {n: m.cameras[0] for n, m in self.measurements.items()}
        self.field = Field(self.needs.design, sensors, radiance_scale, scene.region, scene.unit, cameras, rig_of(scene)).to(self.device)
        frames = sum(len(m.origins) for m in self.measurements.values())
        self.log_gain = torch.nn.Parameter(torch.zeros(frames, device=self.device))
        parameters = {**dict(self.field.named_parameters()), _GAINS: self.log_gain}
        tables = {n for n in parameters if n.endswith(".table")}
        schedule = recipe.schedule
        of_lamps = {n for n in parameters if n.startswith("light.")}
        rates = {n: schedule.learning_rate_light if n in of_lamps else schedule.learning_rate_network for n in parameters}
        rates |= {**dict.fromkeys(tables, schedule.learning_rate_grid), _GAINS: schedule.learning_rate_exposure}
        self.optimiser = Adam(parameters, rates, tables, {"surface.grid.table": schedule.surface_epsilon})
        self.average = Average(parameters)
        self.of_surface = [n for n in parameters if n.startswith("surface.")]
        self.state = FitState(rays=recipe.sampling.initial_rays, rays_after=recipe.sampling.initial_rays)
        self.task = self._task()  # now: poses are as the input has them
        looked_at = 0.0 if fused else rays_to_come  # a look costs a GPU launches, and as much as very many rays of a step
        self.refinement = Refinement(scene, self.measurements, recipe.poses, self.needs.footprint, looked_at, seed)
        self.importance = Importance(self.measurements.chosen, self.measurements.modalities.first_tile, recipe.sampling.evenly)
        self.held = held_out_tiles(self.measurements)
        self.has_opacity = any(m.has_opacity for m in self.measurements.values())
        self.has_empty = self.measurements.empty is not None
        self.on_device: DeviceStep | None = None
        if fused:
            from mmsynth.fitting.device_step import DeviceStep

            given = self.field, self.measurements, self.importance, self.optimiser, self.log_gain, self.needs, recipe, seed
            self.on_device = DeviceStep(*given)
            self.state.rays = max(self.state.rays, self.on_device.first_rays)
        self.settled: tuple[Any, ...] = ()  # by the last step: what is not learned but decided
        self.coming: DrawnStep | None = None
        self.arranged: tuple[ToDraw, kernels.Arranged] | None = None  # the next step, if nothing has changed since that it follows from
        self.renewed: kernels.Selection | None = None  # where rays go from the next step on, if that is due then
        self.spent: tuple[Any, ...] = ()  # of the last step: many small arrays, which take their time to free
        self.points = eikonal_points(recipe, shines=False)  # those near what rays meet are left out where it shines
        self.parts: dict[str, Any] = {
            "field": self.field,
            "optimiser": self.optimiser,
            "average": self.average,
            "refinement": self.refinement,
            "importance": self.importance,
        }

    @property
    def progress(self) -> float:
        """Share of the fit that is done, in [0, 1]."""
        return self._progress_at(self.state.step)

    def _progress_at(self, step: int) -> float:
        if self.steps is not None:
            return min(1.0, step / self.steps)
        return min(1.0, self.state.elapsed / self.budget)  # type: ignore[operator]

    @property
    def kernels_made(self) -> int:
        """Kernels that were compiled, or loaded, as steps came to need them: on a GPU alone, see ``field.warmup`` for a CPU."""
        return kernels.made_on_gpu() if self.device.type == "cuda" else 0

    @property
    def choices(self) -> dict[str, Choice[Any]]:
        """All choices made so far and why, by name."""
        tables, decided = self.state.tables, self.state.decided
        return {
            **self.needs.choices,
            **({} if tables is None else {"tables": tables.choice}),
            **self.refinement.choices,
            **({} if self.state.light is None else {"light": self.state.light}),
            **({} if decided is None else decided.choices),
        }

    def run_step(self) -> None:
        """One optimiser step."""
        state, done = self.state, self.progress
        sampling = sampling_at(done, self.recipe, self.needs)
        if self.on_device is not None:
            self._prepare(sampling, self._random(state.step)[1])
            self._step_on(self.on_device, sampling)
            return
        drawn = self.coming
        if drawn is None:  # the first step of all, or after a checkpoint: by poses and residuals as they were in the step before
            asked = self._to_draw(state.step, state.rays)
            drawn = drawn_step(self.field, self.measurements, asked, [kernels.draw(*drawing) for drawing in asked.drawings])
        self._prepare(sampling, drawn.generator)
        asked, arranged = self.arranged or self._arrange(drawn, state.step)
        rays, state.rays, errors = state.rays, state.rays_after, dict[str, float]()

        def meanwhile(learned: kernels.Learned) -> None:
            self.spent = ()
            self.coming = drawn_step(self.field, self.measurements, asked, learned.drawn)
            if math.isfinite(learned.loss):
                errors.update(self._errors(drawn.batch, learned.squared))
            state.rays_after = self._adapted(rays, samples_of_step(done, self.recipe), int(learned.samples), _MOST_RAYS)
            if (state.step + 1) % _RENEW_EVERY == 0:
                self.renewed = self.importance.renewed(self._held_at(self._progress_at(state.step + 1)))
            self.arranged = self._arrange(self.coming, state.step + 1)

        learned = kernels.learn(arranged, lambda: self._update(sampling), meanwhile)
        self.spent = drawn, asked, arranged
        wrong = self._wrong(learned)
        if wrong is not None:
            self._skip(wrong)
            return
        self.optimiser.count += 1
        self._average()
        keep = 0.98 if state.step else 0.0
        value, before = float(learned.loss), state.mean_loss
        state.mean_loss = value if math.isnan(before) else keep * before + (1 - keep) * value  # nan: all were skipped
        for name, error in errors.items():
            state.mean_error[name] = keep * state.mean_error.get(name, error) + (1 - keep) * error
        state.rays_total += len(drawn.batch.origins)
        state.samples_total += int(learned.samples)
        state.step += 1

    def _adapted(self, rays: float, wanted: float, samples: float, most: int) -> int:
        """The number of rays for a step of so many samples: half of the way there, of a factor of two at the most either way.

        Args:
            rays: that gave ``samples``. wanted: samples.
        """
        ratio = min(2.0, max(0.5, wanted / max(samples, 1)))
        return int(min(most, max(len(self.measurements), 0.5 * rays * (1 + ratio))))

    def _step_on(self, step: DeviceStep, sampling: kernels.Sampling) -> None:
        """A step that the device takes while the host goes on; what earlier ones told is taken in."""
        state, done = self.state, self.progress
        early = is_early(done, self.recipe)
        stage = step.stage(
            sampling, state.rays, state.decided is not None, self._has_gains, early, pairs_at(done, self.recipe, self.needs), _OUTSIDE
        )
        factor, of_surface = learning_rate_factor(done, self.recipe), surface_rates(sampling.sharpness, self.recipe)
        step.run(stage, sampling, state.step, factor, of_surface, surface_beta2(done, self.needs))
        self._average()
        state.rays_total += sum(stage.rays)
        state.step += 1
        self._hear(step, wait=False)

    def _hear(self, step: DeviceStep, wait: bool) -> None:
        """Take in what the device tells of the steps before."""
        state, news = self.state, step.news(wait)
        if news is None:
            return
        state.samples_total += news.samples
        state.bad_steps += news.bad
        if state.bad_steps >= _BAD_STEPS:
            raise DivergedError(f"fit: loss or gradients are not finite in {state.bad_steps} steps (last: before step {state.step}).")
        if news.steps > news.bad:
            keep = 0.0 if math.isnan(state.mean_loss) else 0.98 ** (news.steps - news.bad)
            state.mean_loss = news.loss if keep == 0.0 else keep * state.mean_loss + (1 - keep) * news.loss
            for name, error in news.errors.items():
                state.mean_error[name] = keep * state.mean_error.get(name, error) + (1 - keep) * error
        wanted = max(samples_of_step(self.progress, self.recipe), step.samples)
        state.rays = self._adapted(news.rays / news.steps, wanted, news.samples / news.steps, step.most_rays)

    def _prepare(self, sampling: kernels.Sampling, generator: torch.Generator) -> None:
        """What is due before a step: the occupancy grid, where rays go, the rows of the tables, what residuals decide, the poses."""
        state, schedule, field = self.state, self.recipe.schedule, self.field
        if state.step % self.recipe.sampling.occupancy_every == 0:
            turn = state.step // self.recipe.sampling.occupancy_every or None  # all cells at the start
            if not field.occupancy.update(field.surface.at(sampling.active_surface), sampling.sharpness, turn):
                state.reopened += 1
        held = self._held_at(self.progress)
        if state.step % _RENEW_EVERY == 0:
            if self.renewed is None:
                self.importance.renew(held)
                self.arranged = None
            else:
                self.importance.selection, self.renewed = self.renewed, None
        if state.tables is None and 0 < schedule.tables_at <= self.progress:
            state.tables = size_tables(field, self.recipe, sampling, generator)
            self._resize_tables(state.tables, generator)
        dark = False  # that there are no lamps is asked after a look alone: a GPU would be waited for
        if state.light is None and state.light_looks < light_looks(self.progress, self.recipe):
            look_for_lamps(field, self.measurements, sampling, self.seed)
            state.light_looks += 1
            dark = not field.shines
        if state.light is None and (dark or self.progress >= schedule.light_until):
            asked = field, self.measurements, selections(self.importance, held), self.recipe.radiance, self.needs, sampling, self.seed
            state.light = decide_light(*asked)
            self._mirror(state.light)
            look_for_lamps(field, self.measurements, sampling, self.seed)
        if state.decided is None:
            # a surface in the wrong place can be painted right for every view; it cannot while its colour has no direction
            seen = 0 if self.progress < schedule.view_dependence_from else DEGREES
            field.view_dependence.update(dict.fromkeys(self.measurements, seen))
            if self.progress >= schedule.decide_at:
                asked = field, self.measurements, selections(self.importance, held), self.recipe.radiance, self.needs, sampling, self.seed
                state.decided = decide(*asked)
                if field.shines:  # by now lamps have found their places
                    keep_bright_lamps(field, self.measurements, sampling, self.seed)
                self._see_directions(state.decided)
        if state.step % _MOVE_EVERY == 0 and self.refinement.due(self.progress):
            self.refinement.step(functools.partial(self._looks, sampling), self.progress)
        settled = state.light_looks, *(x is None for x in (state.tables, state.light, state.decided)), *field.view_dependence.values()
        if settled != self.settled:
            self.settled, self.arranged = settled, None
            give_back()  # decisions look at many rays at once, steps never do
            if self.on_device is not None:
                self.on_device.renew()

    def _held_at(self, progress: float) -> torch.Tensor | None:
        """Tiles of the views that are held out while directions are on trial."""
        on_trial = self.recipe.radiance.view_dependence == "auto" and self.recipe.schedule.view_dependence_from <= progress
        return self.held if on_trial and self.state.decided is None else None

    def _random(self, step: int) -> tuple[np.random.Generator, torch.Generator]:
        """The random numbers of a step."""
        random = np.random.default_rng((self.seed, 1, step))
        return random, torch.Generator().manual_seed(int(random.integers(2**62)))

    def _to_draw(self, step: int, rays: int) -> ToDraw:
        """The rays of a step."""
        random, generator = self._random(step)
        total = sum(self.needs.share.values())
        counts = {n: max(1, int(rays * share / total)) for n, share in self.needs.share.items()}
        selection = self.importance.selection if self.renewed is None else self.renewed
        of_pixels = drawing_of(self.measurements, self.field.shader.columns, counts, random, selection)
        points = *self.points, pairs_at(self._progress_at(step), self.recipe, self.needs)
        if not self.has_empty:
            return ToDraw(counts, (of_pixels,), points, generator)
        # rays outside the object's masks, whose opacity should be 0. Their colours are those of a background that is not the object's, or
        # of a picture that was painted white there: they are not looked at
        outside = {name: -(-count // _OUTSIDE) for name, count in counts.items()}
        return ToDraw(counts, (of_pixels, empty_drawing_of(self.measurements, outside, random)), points, generator)

    def _wrong(self, learned: kernels.Learned) -> str | None:
        """What is wrong where the loss or its gradients are not finite, and then no gradient is left."""
        # what is NaN in a sample is NaN in a sum
        if not math.isfinite(learned.loss):
            reason = "the loss is not finite"
        elif not math.isfinite(learned.gradients):
            reason = "a gradient is not finite"
        else:
            return None
        self.optimiser.clear()
        return reason

    def _update(self, sampling: kernels.Sampling) -> list[kernels.AdamPart]:
        """What a step of the optimiser takes."""
        rates = surface_rates(sampling.sharpness, self.recipe)
        slower = {n: rates.table if n.endswith(".table") else rates.network for n in self.of_surface}
        beta2 = dict.fromkeys((n for n in slower if not n.endswith(".table")), surface_beta2(self.progress, self.needs))
        return self.optimiser.parts(learning_rate_factor(self.progress, self.recipe), slower, beta2)

    def _average(self) -> None:
        """Take the parameters into the mean over the last ones, now and then at the end of a fit."""
        done, length = self.progress, self.recipe.schedule.ema_fraction
        if length > 0 and done >= 1.0 - 4.0 * length and self.state.step % _AVERAGE_EVERY == 0:
            self.average.update(length * self.state.step / max(done, 1e-9) / _AVERAGE_EVERY)

    def _arrange(self, drawn: DrawnStep, step: int) -> tuple[ToDraw, kernels.Arranged]:
        """A step, and what is drawn beside it: the rays of the one after it."""
        asked, done = self._to_draw(step + 1, self.state.rays_after), self._progress_at(step)
        of_step = self._of_step(drawn, sampling_at(done, self.recipe, self.needs), done)
        return asked, kernels.arrange(of_step, asked.drawings)

    def _of_step(self, drawn: DrawnStep, sampling: kernels.Sampling, progress: float) -> kernels.Step:
        """What is learned from, and how."""
        field, batch, rays = self.field, drawn.batch, drawn.rays
        # a few frames would bend geometry, appearance and trunk to themselves: sparse modalities teach their own head alone
        trains = batch.per_ray({n: n not in self.needs.sparse for n in batch.parts})
        outside = len(rays.origins) - len(trains)
        degrees = batch.per_ray(field.view_dependence)
        if outside:
            degrees, trains = pad(degrees, (0, outside)), pad(trains, (0, outside), value=True)
        light = field.light.network() if field.light is not None and field.shines else kernels.no_light(self.device)
        # light from beyond the region would explain what is in it as long as that has no shape
        none = rays.origins.new_empty(0)
        far_light = field.far_light if field.far_light is not None and self.state.decided is not None else none
        log_gain = self.log_gain if self._has_gains else none
        return kernels.Step(
            *field.surface.at(sampling.active_surface), field.appearance.at(sampling.active_radiance), field.occupancy.states,
            field.shader.weights(), light, far_light, rays, kernels.View(degrees, trains), batch.measured,
            kernels.Gains(log_gain, batch.frame),
            opacities(batch, outside, self.has_opacity, self.needs.black_background, self.recipe, progress),
            eikonal(field, sampling, self.recipe, progress, drawn.points, drawn.noise), smooth(drawn.aside.to(self.device), self.recipe),
            sampling, self.recipe.sampling.roulette,
        )  # fmt: skip

    def _errors(self, batch: Batch, squared: torch.Tensor) -> dict[str, float]:
        """Mean squared error of each modality; what residuals say of where to look is kept."""
        out, relative = {}, np.empty(len(batch.origins), np.float32)
        of_numbers, weight = squared.numpy(force=True), batch.ray_weight.numpy(force=True)  # on a GPU without Triton, too
        for name, (rays, numbers) in batch.parts.items():
            found, count = of_numbers[numbers], rays.stop - rays.start
            if len(found) > count:
                found = found.reshape(count, -1).mean(1)
            out[name] = float(weight[rays] @ found) / count
            relative[rays] = np.sqrt(found) / self.measurements[name].radiance_scale
        self.importance.learn(batch.tile, torch.from_numpy(relative).to(batch.tile.device))
        return out

    @property
    def _has_gains(self) -> bool:
        return self.state.decided is not None and self.state.decided.exposure.value

    def _gain(self) -> torch.Tensor:
        """Exposure of every frame relative to their mean."""
        return torch.exp(self.log_gain - self.log_gain.mean())

    def _gain_of(self, batch: Batch) -> torch.Tensor | None:
        """Exposure of each number's frame, (M,); None where no gains were needed."""
        return self._gain()[batch.frame] if self._has_gains else None

    def _looks(self, sampling: kernels.Sampling, rays: dict[str, int], count: int, random: np.random.Generator) -> Iterator[RayJacobian]:
        # what is off has large residuals; drawn evenly, few rays would meet a small object before nothing. Held-out views move, too
        drawn_from = self.importance.renewed()
        batches = (draw(self.measurements, self.field.shader.columns, rays, random, drawn_from) for _ in range(count))
        return ray_residuals(self.field, batches, self._gain_of, self.state.decided is not None, sampling)

    def _resize_tables(self, sizes: TableSizes, generator: torch.Generator) -> None:
        kept = self.field.resize_tables(sizes.surface, sizes.radiance, sizes.first, generator)
        for name, rows in kept.items():
            self.optimiser.resize(name, rows)
            self.average.resize(name, rows)

    def _mirror(self, light: Choice[bool]) -> None:
        if not light.value and self.field.light is not None:
            for name, _ in self.field.light.named_parameters(prefix="light"):
                self.optimiser.forget(name)
                self.average.forget(name)
            self.field.light = None
            self.field.design = replace(self.field.design, light=False)

    def _see_directions(self, decisions: Decisions) -> None:
        self.field.view_dependence.update({name: choice.value for name, choice in decisions.view_dependence.items()})

    def _skip(self, reason: str) -> None:
        self.state.step += 1
        self.state.bad_steps += 1
        if self.state.bad_steps >= _BAD_STEPS:
            raise DivergedError(f"fit: {reason} in {self.state.bad_steps} steps (last: step {self.state.step}); the checkpoint is kept.")

    def gains(self) -> dict[str, list[float]]:
        """Exposure of each training frame relative to the mean, per modality; empty when no gains were needed."""
        if not self._has_gains:
            return {}
        order = self.measurements.order
        parts = self._gain().detach().cpu().split([len(self.measurements[n].origins) for n in order])
        return {n: part.tolist() for n, part in zip(order, parts, strict=True)}

    def report(self) -> FitProgress:
        """News for a progress bar."""
        s = self.state
        psnr = {n: psnr_from_mse(e) for n, e in s.mean_error.items()}
        rate = 1.0 / max(s.elapsed, 1e-9)
        return FitProgress(s.step, self.progress, s.elapsed, s.mean_loss, psnr, s.rays_total * rate, s.samples_total * rate)

    def checkpoint(self) -> dict[str, Any]:
        """All state, as tensors and numbers."""
        if self.on_device is not None:
            self._hear(self.on_device, wait=True)
            self.on_device.sync()
        parts = {name: part.state_dict() for name, part in self.parts.items()}
        return {"task": self.task, "log_gain": self.log_gain.detach(), "state": asdict(self.state), **parts}

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
        self.state = TypeAdapter(FitState).validate_python(saved["state"])
        if self.state.tables is not None:
            self._resize_tables(self.state.tables, torch.Generator())  # what is new is read from the checkpoint
        if self.state.light is not None:
            self._mirror(self.state.light)
        for name, part in self.parts.items():
            part.load_state_dict(saved[name])
        self.log_gain.data.copy_(saved["log_gain"])
        self.coming = self.arranged = self.renewed = None
        if self.on_device is not None:
            self.on_device.resume()
        if self.state.decided is not None:
            self._see_directions(self.state.decided)

    def _task(self) -> dict[str, Any]:
        """What a checkpoint must agree on to be resumed: hash of the pixels and poses, recipe, seed, length."""
        return {
            "scene": fingerprint(self.measurements),
            "recipe": json.dumps(self.recipe.model_dump(), sort_keys=True),
            "seed": self.seed,
            "steps": self.steps or 0,
            "budget": self.budget or 0.0,
        }
