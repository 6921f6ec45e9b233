"""A step of a fit on a GPU, without the host: rays are drawn there, learned from and judged there, and the optimiser steps there.

The host says what changes from step to step by the arguments of one small kernel and starts a graph, one for each ``Stage`` of the fit. It
reads what the device tells of its steps from time to time, when the next that it tells is on its way: the number of rays follows the
samples that late, and no result depends on how quick either is. A step whose loss or gradients are not finite is not taken, which the
device decides, too.

All parameters but the tables lie in one array, with their gradients and moments in others: one kernel steps them all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mmsynth.field import kernels, rendering
from mmsynth.field.field import MIRROR_CELLS, Field
from mmsynth.field.kernels.cuda import drawing, optimiser, stepping
from mmsynth.field.kernels.cuda.learning import learn_all
from mmsynth.field.kernels.learning import gradient_of
from mmsynth.fitting import importance, smoothness
from mmsynth.fitting.graphs import Repeated
from mmsynth.fitting.importance import Importance
from mmsynth.fitting.measurements import Measurements
from mmsynth.fitting.needs import SAMPLES_ON_GPU, Needs
from mmsynth.fitting.optimiser import BETAS, EPSILON, Adam
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.schedule import SurfaceRates, blocked_weight, shallow_factor
from mmsynth.fitting.terms import eikonal_points

MOST_RAYS = 1 << 18
_NEWS_EVERY = 16  # steps, and by as many the host is ahead of the device at the most: a fit of so many seconds ends when it should
_PER_OCTAVE = 4  # numbers of rays for which there are graphs: within 10 % of what is asked for
_TABLES = {"surface.grid.table": 2, "appearance.table": 0}  # and which of ``Numbers.factors`` is theirs


@dataclass(frozen=True)
class Stage:
    """What a graph is captured for: all that changes shapes or which kernels there are.

    Attributes:
        active: levels of surface and radiance. degrees: of direction, of each modality. lamps: those that there are. far_light, gains:
            whether there are. early: whether slopes below 1 count less. pairs: of neighbouring
            normals that are pulled together. rays, outside: of each modality, those drawn and those where
            nothing is.
    """

    active: tuple[int, int]
    degrees: tuple[int, ...]
    lamps: tuple[int, ...]
    far_light: bool
    gains: bool
    early: bool
    pairs: int
    rays: tuple[int, ...]
    outside: tuple[int, ...]


class News(NamedTuple):
    """Of some steps together: how many, how many of them were bad, rays, samples; of a good one the mean loss and squared error per
    modality, NaN where none was good."""

    steps: int
    bad: int
    rays: int
    samples: int
    loss: float
    errors: dict[str, float]


class _Told(NamedTuple):
    """What the device told of all its steps until then, when it has arrived (None: at once), and the rays of these steps."""

    numbers: Tensor
    arrival: torch.cuda.Event | None
    rays: int


class _Flat(NamedTuple):
    """Parameters, gradients, moments, rates, one after the other, and which of ``Numbers.factors`` multiplies a rate (uint8)."""

    values: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    rates: Tensor
    kinds: Tensor


def bucket(rays: float) -> int:
    """The nearest number of rays for which there are graphs."""
    return round(2.0 ** (round(_PER_OCTAVE * np.log2(max(rays, 1.0))) / _PER_OCTAVE))


class DeviceStep:
    """The steps of one fit on its device.

    The field's parameters and the optimiser's moments become parts of its arrays; ``sync`` brings the optimiser's count up to date.

    Args:
        capture: whether stages become graphs.
    """

    samples, most_rays = SAMPLES_ON_GPU, MOST_RAYS
    first_rays = SAMPLES_ON_GPU // 16  # a ray of the first steps takes about as many samples; each other number has a graph of its own

    def __init__(
        self,
        field: Field,
        measurements: Measurements,
        where: Importance,
        adam: Adam,
        log_gain: Tensor,
        needs: Needs,
        recipe: Recipe,
        seed: int,
        capture: bool = True,
    ) -> None:
        self.field, self.measurements, self.where, self.adam = field, measurements, where, adam
        self.log_gain, self.needs, self.recipe, self.seed, self.capture = log_gain, needs, recipe, seed, capture
        device = field.device
        self.order = measurements.order
        columns = [field.shader.columns[n].start for n in self.order]
        self.modalities = measurements.modalities._replace(output=torch.tensor(columns, dtype=torch.int32, device=device))
        self.values = [measurements[n].values for n in self.order]
        self.polarized = [measurements[n].sensor.is_polarization for n in self.order]
        self.chosen = where.selection  # what is in the arrays of ``selection``, which stay
        self.selection = self.chosen._replace(ends=self.chosen.ends.clone(), weight=self.chosen.weight.clone())
        self.numbers = stepping.new_numbers(device)
        self.steps = torch.tensor([0, adam.count], dtype=torch.int32, device=device)
        self.told = torch.zeros(4 + len(self.order), dtype=torch.float64, device=device)
        self.rays, self.heard = 0, _Told(torch.zeros(len(self.told), dtype=torch.float64), None, 0)
        self.copies: list[_Told] = []
        self.flat, self.begins = self._flatten()
        self.rates = {n: torch.full((1,), adam.rates[n], device=device) for n in _TABLES}
        self.works: dict[Stage, Repeated] = {}
        self.tables: list[int] = []
        self.pool: Any = None
        self.lamps: tuple[int, ...] = ()
        self.renew()

    def _flatten(self) -> tuple[_Flat, dict[str, int]]:
        """Lay the small parameters one after the other, the shader's first, in the order that ``learn_all`` sums; where each begins."""
        shader, light = list(self.field.shader.parameters()), self.field.light
        first: list[Tensor] = [*shader, *([] if self.field.far_light is None else [self.field.far_light])]
        first += [] if light is None else light.network()[:6]
        place = {id(p): i for i, p in enumerate(first)}
        names = [n for n in self.adam.parameters if n not in _TABLES]
        names.sort(key=lambda n: place.get(id(self.adam.parameters[n]), len(place)))
        parts = [self.adam.parameters[n] for n in names]
        sizes = [p.numel() for p in parts]
        join = lambda tensors: torch.cat([x.detach().reshape(-1) for x in tensors])
        moments = [[self.adam.moments[n][k] for n in names] for k in (0, 1)]
        rates = [torch.full((size,), self.adam.rates[n], device=self.field.device) for n, size in zip(names, sizes, strict=True)]
        kinds = [torch.full_like(rate, n.startswith("surface."), dtype=torch.uint8) for n, rate in zip(names, rates, strict=True)]
        values = join(parts)
        flat = _Flat(values, torch.zeros_like(values), join(moments[0]), join(moments[1]), torch.cat(rates), torch.cat(kinds))
        begins, begin = {}, 0
        for name, p, size in zip(names, parts, sizes, strict=True):
            own = [x[begin : begin + size].view(p.shape) for x in flat[:4]]
            p.data, p.grad, self.adam.moments[name], begins[name] = own[0], own[1], own[2:], begin
            begin += size
        return flat, begins

    def stage(self, sampling: kernels.Sampling, rays: float, decided: bool, gains: bool, early: bool, pairs: int, outside: int) -> Stage:
        """Of a step with so many rays of all modalities, and one in ``outside`` as many where nothing is.

        Args:
            decided: whether far light is seen. gains: whether exposures differ. early: whether slopes below 1 count less. pairs: see
                ``Stage``.
        """
        share = [self.needs.share[n] for n in self.order]
        counts = tuple(max(1, int(bucket(rays) * s / sum(share))) for s in share)
        empty = tuple(-(-c // outside) if self.measurements[n].empty else 0 for n, c in zip(self.order, counts, strict=True))
        light = self.field.light
        return Stage(
            (sampling.active_surface, sampling.active_radiance), tuple(self.field.view_dependence[n] for n in self.order),
            self.lamps if light is not None else (), decided and self.field.far_light is not None, gains, early, pairs, counts, empty,
        )  # fmt: skip

    def renew(self) -> None:
        """Take up what was changed between steps: lamps, tables of other sizes."""
        light = self.field.light
        self.lamps = () if light is None else tuple(torch.nonzero(light.used)[:, 0].tolist())
        tables = [x.data_ptr() for n in _TABLES for x in (self.adam.parameters[n], *self.adam.moments[n])]
        if tables != self.tables:
            self.works.clear()  # their arrays are gone
            self.pool = torch.cuda.graph_pool_handle() if self.field.device.type == "cuda" else None  # memory of graphs goes with them
        self.tables = tables

    def run(self, stage: Stage, sampling: kernels.Sampling, number: int, factor: float, of_surface: SurfaceRates, beta2: float) -> None:
        """A step, of rays where they go by now.

        Args:
            number: of the step, for its random numbers. factor: of all learning rates. of_surface: of the surface's, beside. beta2: of the
                surface's network.
        """
        if stage not in self.works:
            self.works[stage] = Repeated(self._work(stage, sampling), self.field.device, self.capture, self.pool)
        if self.where.selection is not self.chosen:
            self.chosen = self.where.selection
            self.selection.ends.copy_(self.chosen.ends)
            self.selection.weight.copy_(self.chosen.weight)
        key = np.random.SeedSequence((self.seed, 1, number)).generate_state(4).tolist()
        betas = BETAS[1], beta2, BETAS[1]
        stepping.set_numbers(self.numbers, sampling.sharpness, sampling.step, factor, of_surface, betas, key)
        self.works[stage]()
        self.rays += sum(stage.rays)
        if (number + 1) % _NEWS_EVERY == 0:
            self._tell()

    def _work(self, stage: Stage, sampling: kernels.Sampling) -> Callable[[], None]:
        """What a step of a stage does, with arrays that stay."""
        field, numbers, m, loss = self.field, self.numbers, self.measurements, self.recipe.loss
        device, grid = field.device, field.surface.grid
        ints = lambda values, dtype=torch.int32: torch.tensor(values, dtype=dtype, device=device)
        begins = [drawing.begins_of(self.values, self.polarized, counts) for counts in (stage.rays, stage.outside)]
        tables = stepping.Tables(
            ints(self.values), ints(stage.degrees), ints([n not in self.needs.sparse for n in self.order]), ints(begins[0], torch.int64)
        )
        of_outside = ints(begins[1], torch.int64)
        sizes = [(b[0][-1], b[1][-1], b[2][-1], max(counts)) for b, counts in zip(begins, (stage.rays, stage.outside), strict=True)]
        rays, outside = sizes[0][0], sizes[1][0]
        has_opacity = any(x.has_opacity for x in m.values())
        solid = blocked_weight(stage.early, self.recipe)
        known = stepping.Known(
            loss.alpha_weight / rays, loss.alpha_weight / max(outside, 1), loss.background_opacity_weight / rays,
            solid / rays, solid / max(outside, 1), math.exp(-sampling.max_optical_depth),
            has_opacity or self.needs.black_background, self.needs.black_background and not has_opacity,
        )  # fmt: skip
        bounds, contracted = (rendering.NEAR, rendering.FREE, rendering.FARTHEST), grid.extent > 1.0
        free, asked = eikonal_points(self.recipe, len(stage.lamps) > 0)
        cell = grid.cell(stage.active[0])
        shallow = shallow_factor(stage.early, self.recipe)
        surface, appearance = field.surface.at(stage.active[0]), field.appearance.at(stage.active[1])
        none = torch.empty(0, device=device)
        shader = field.shader.weights()
        network = kernels.no_light(device)
        if field.light is not None and stage.lamps:
            network = field.light.network()._replace(used=ints(stage.lamps, torch.int64))
        far_light = field.far_light if stage.far_light and field.far_light is not None else none
        of_shader = self.flat.gradient[: sum(w.numel() for w in (*shader, far_light))]
        light_begin = self.begins.get("light.first.weight", 0)
        of_light = self.flat.gradient[light_begin : light_begin + sum(w.numel() for w in network[:6])]
        log_gain = self.log_gain if stage.gains else none
        now = sampling._replace(sharpness=numbers.sharpness, step=numbers.step)  # type: ignore[arg-type]
        rows = field.rows_met(sampling)
        whole = lambda *shape: torch.empty(shape, device=device)

        def work() -> None:
            origins, directions, jitter = whole(rays + outside, 3), whole(rays + outside, 3), whole(rays + outside)
            drawn = drawing.draw_all(
                m.frames, m.cameras, self.modalities, self.selection, tables.begins, sizes[0], len(self.order), numbers.key[:2],
                (origins[:rays], directions[:rays], jitter[:rays]),
            )  # fmt: skip
            if m.empty is not None and outside:
                drawing.draw_all(
                    m.frames, m.cameras, self.modalities, m.empty, of_outside, sizes[1], 1, numbers.key[2:],
                    (origins[rays:], directions[rays:], jitter[rays:]),
                )  # fmt: skip
            aimed, view, opacities = stepping.aim(drawn, origins, directions, jitter, tables, known, bounds, contracted)
            at, noise, aside = stepping.random_points(
                numbers, (free, asked, stage.pairs), grid.extent, 3.0, (smoothness.LEAST, smoothness.MOST)
            )
            eikonal = kernels.Eikonal(at, noise, loss.eikonal_weight, cell, MIRROR_CELLS * cell, shallow)
            told = kernels.Step(
                *surface, appearance, field.occupancy.states, shader, network, far_light, aimed, view, drawn.measured,
                kernels.Gains(log_gain, drawn.frame), opacities, eikonal, smoothness.smooth(aside, self.recipe), now,
            )  # fmt: skip
            loss_parts, squared, samples = learn_all(told, of_shader, of_light)
            f = self.flat
            optimiser.check(loss_parts, f.gradient, samples, self.steps, self.told[:4])
            of_kinds = numbers.factors, numbers.beta2
            optimiser.guarded_adam(f.values, f.gradient, (f.first, f.second), f.rates, f.kinds, of_kinds, self.steps, BETAS[0], EPSILON)
            for name, kind in _TABLES.items():
                p, moments = self.adam.parameters[name], self.adam.moments[name]
                optimiser.guarded_adam(
                    p[: rows[name]], gradient_of(p)[: rows[name]], (moments[0], moments[1]), self.rates[name], kind, of_kinds, self.steps,
                    BETAS[0], self.adam.epsilons[name], sparse=True,
                )  # fmt: skip
            stepping.tally(drawn, squared, tables, self.steps, self.where.residuals, self.told[4:], importance.KEPT)

        return work

    def _tell(self) -> None:
        """Send what the device tells on its way, when what it told before has arrived."""
        if self.copies and (before := self.copies[-1].arrival) is not None:
            before.synchronize()
        if self.told.device.type == "cpu":
            self.copies.append(_Told(self.told.clone(), None, self.rays))
            return
        copy = torch.empty(self.told.shape, dtype=self.told.dtype, pin_memory=True)
        copy.copy_(self.told, non_blocking=True)
        event = torch.cuda.Event()
        event.record(torch.cuda.current_stream(self.told.device))
        self.copies.append(_Told(copy, event, self.rays))

    def news(self, wait: bool = False) -> News | None:
        """What was told before the last time, None: nothing. ``wait``: for all that was done until now."""
        if wait:
            self._tell()
            if (last := self.copies[-1].arrival) is not None:
                last.synchronize()
        latest = None
        while len(self.copies) > (0 if wait else 1):
            latest = self.copies.pop(0)
        if latest is None or not (more := (latest.numbers - self.heard.numbers).numpy())[0]:
            return None
        rays, self.heard = latest.rays - self.heard.rays, latest
        good = more[0] - more[1]
        mean = lambda total: float(total / good) if good else float("nan")
        errors = dict(zip(self.order, map(mean, more[4:]), strict=True))
        return News(int(more[0]), int(more[1]), rays, int(more[2]), mean(more[3]), errors)

    def sync(self) -> None:
        """Wait for the device, and let the optimiser know how often it stepped."""
        self.adam.count = int(self.steps[1])

    def resume(self) -> None:
        """Begin from the optimiser's count, after its state was read."""
        self.steps[1] = self.adam.count
