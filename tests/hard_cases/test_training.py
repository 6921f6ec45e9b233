"""Hard cases of a fit: numbers that are not finite, a killed run, sharpness, grids that must open again, rays that follow residuals."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from small_scenes import FOCAL, QUICK, RADIUS, around, picture, write_scene
from usual import nerfacc_keeps, neus_weights

from mmsynth.errors import DivergedError
from mmsynth.field.kernels import OUTSIDE, SHELL, Rays, ShadedRays, odds, reference
from mmsynth.field.rendering import ball_interval
from mmsynth.fitting import motions as poses
from mmsynth.fitting.measurements import draw
from mmsynth.fitting.motions import RayJacobian
from mmsynth.fitting.progress import FitProgress
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import fit
from mmsynth.fitting.schedule import sampling_at
from mmsynth.fitting.trainer import Trainer
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene
from mmsynth.sensors.camera import ray_map

TILE = 32  # pixels
Row = Callable[[str, str, str], None]


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return load_scene(write_scene(tmp_path / "scene", {"rgb": around(6)}))


def _trainer(scene: Scene, steps: int = 40, **changes: object) -> Trainer:
    return Trainer(scene, QUICK.with_changes(changes), steps, None, 0, "cpu")


def _unchecked_step(trainer: Trainer) -> tuple[float, float]:
    """The trainer's loss by single operations, of a batch with the bad pixel, and torch's Adam: share of residuals NaN before and after."""
    field, batches = trainer.field, (np.random.default_rng(seed) for seed in range(1000))
    batch = next(
        b for r in batches for b in [draw(trainer.measurements, field.shader.columns, {"rgb": 128}, r)] if b.measured.target.isnan().any()
    )
    o, d, zero = batch.origins, batch.directions, torch.zeros(128)
    sampling, optimiser, lost = sampling_at(0.0, trainer.recipe, trainer.needs), torch.optim.Adam(field.parameters(), 1e-3), []
    for _ in range(2):
        tables = *field.surface.at(sampling.active_surface), field.appearance.at(sampling.active_radiance)
        hits = reference.trace(*tables, field.occupancy.states, Rays(o, d, *ball_interval(o, d), zero), sampling)
        shaded = ShadedRays(hits.features, hits.share, hits.behind, d, zero.long(), zero == 0)
        loss, squared = reference.compare(field.shader.weights(), shaded, batch.measured)
        lost.append(float(squared.isnan().float().mean()))
        loss.backward()
        optimiser.step()
    return lost[0], lost[1]


@pytest.mark.usefixtures("decided_by_few_rays")
def test_one_bad_pixel_spoils_one_step(row: Row, scene: Scene) -> None:
    """A value that turned NaN in memory: steps that meet it change nothing, all others go on."""
    trainer = _trainer(scene)
    frames = trainer.measurements.frames
    values = frames.codes16.float() / 65535
    values[40] = math.nan
    trainer.measurements.frames = frames._replace(kind=torch.full_like(frames.kind, 2), floats=values)
    skipped = 0
    while trainer.progress < 1:
        before = {n: p.detach().clone() for n, p in trainer.field.named_parameters()}
        bad = trainer.state.bad_steps
        trainer.run_step()
        if trainer.state.bad_steps > bad:
            skipped += 1
            assert all(torch.equal(p, before[n]) for n, p in trainer.field.named_parameters())
    assert 0 < skipped < 20 and all(torch.isfinite(p).all() for p in trainer.field.parameters())
    before, after = _unchecked_step(trainer)
    assert 0 < before < 0.05 and after == 1
    row(
        "a pixel that is NaN, 40 steps",
        f"a step with it, unchecked: {before:.1%} of the numbers NaN before, {after:.0%} after",
        f"{skipped} steps skipped and counted, all weights finite",
    )


def _hidden_eikonal(trainer: Trainer, steps: int) -> tuple[float, float]:
    """Neuralangelo's eikonal loss, NaN read as 0, in torch's Adam: the largest loss of some steps, and the share of weights NaN at last."""
    surface = trainer.field.surface
    optimiser = torch.optim.Adam(surface.parameters(), 1e-3)
    points, worst = torch.rand(64, 3, generator=torch.Generator().manual_seed(0)) - 0.5, 0.0
    for _ in range(steps):
        loss = (surface.gradient(points, 0.01, 2).norm(dim=1) - 1).square().nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        worst = max(worst, float(loss.detach()))
    return worst, float(torch.cat([p.detach().flatten() for p in (surface.hidden, surface.output_weight)]).isnan().float().mean())


@pytest.mark.parametrize("table", ["appearance.table", "surface.grid.table"])
def test_nothing_but_bad_steps_is_given_up(row: Row, scene: Scene, table: str) -> None:
    trainer = _trainer(scene)
    with torch.no_grad():
        dict(trainer.field.named_parameters())[table].fill_(math.inf)
    with pytest.raises(DivergedError, match="not finite in 20 steps"):
        while trainer.progress < 1:
            trainer.run_step()
    assert trainer.state.step == 20
    if table.startswith("surface"):
        loss, lost = _hidden_eikonal(trainer, 100)
        assert loss == 0
        row(
            "a fit whose surface has diverged",
            f"Neuralangelo's nan_to_num: the loss reads {loss:.0f} for 100 steps, {lost:.0%} of the weights are NaN",
            "given up after 20 steps, in one sentence",
        )


def _resumed_from_parameters(scene: Scene, recipe: Recipe, at: int) -> float:
    """No moments, no step and no random state: the mean distance [radii] of its surface from that of the fit that was not cut."""
    whole, cut, resumed = (Trainer(scene, recipe, 40, None, 0, "cpu") for _ in range(3))
    for trainer, steps in ((whole, 40), (cut, at), (resumed, 40 - at)):
        if trainer is resumed:
            trainer.field.load_state_dict(cut.field.state_dict())
        for _ in range(steps):
            trainer.run_step()
    points = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    return float((whole.field.surface(points, 3) - resumed.field.surface(points, 3)).detach().abs().mean())


@pytest.mark.usefixtures("decided_by_few_rays")
def test_a_killed_fit_goes_on_as_if_it_had_not_been(row: Row, scene: Scene, tmp_path: Path) -> None:
    """Killed where levels open, tables are sized, directions are decided."""
    recipe = QUICK.with_changes({"poses.views": "on"})
    whole = fit(scene, tmp_path / "whole", recipe=recipe, steps=40)
    for at in (1, 3, 13, 25, 39):

        def kill(news: FitProgress, at: int = at) -> None:
            if news.step == at:
                raise RuntimeError("killed")

        with pytest.raises(RuntimeError, match="killed"):
            fit(scene, tmp_path / f"cut{at}", recipe=recipe, steps=40, checkpoint_every=0.0, on_step=kill)
        resumed = fit(scene, tmp_path / f"cut{at}", recipe=recipe, resume=True)
        assert all(torch.equal(a, b) for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True)), at
    off = _resumed_from_parameters(scene, QUICK.with_changes({"schedule.tables_at": 0, "radiance.light": "off"}), 25)
    assert off > 0.005
    row(
        "killed after 1, 3, 13, 25, 39 of 40 steps and resumed",
        f"from the parameters alone, after 25: a surface {off:.2g} radii away",
        "the same field to the last bit",
    )


def _learned_sharpness(scene: Scene, steps: int) -> list[float]:
    """NeuS's s = exp(10 p), p from 0.3 at MultimodalStudio's rate of 1e-3, all else known: the ball and its paint, 64 even samples."""
    frames = scene.frames_of("rgb")
    pixels = np.random.default_rng(0).integers((len(frames), 24, 32), size=(100, 3)).T
    d = torch.tensor(np.stack([ray_map(frames[f].camera)[0][v, u] @ frames[f].camera_to_world[:3, :3].T for f, v, u in pixels.T]))
    o = torch.tensor(np.stack([frames[f].camera_to_world[:3, 3] for f in pixels[0]]))
    seen = torch.tensor(np.stack([picture(around(6)[frames[f].view])[v, u] for f, v, u in pixels.T]))
    x = o[:, None] + d[:, None] * (torch.linspace(-1, 1, 65) - (o * d).sum(1, keepdim=True))[..., None]
    paint = 0.4 + 0.25 * torch.sin(4 * torch.nn.functional.normalize(x[:, :-1], dim=-1) + torch.tensor([0.0, 1.0, 2.0]))
    p = torch.tensor(0.3, requires_grad=True)
    optimiser, s = torch.optim.Adam([p], 1e-3), []
    for _ in range(steps):
        s.append(math.exp(10 * float(p.detach())))
        weights = neus_weights(x.norm(dim=-1) - RADIUS, torch.exp(10 * p))
        optimiser.zero_grad()
        ((weights[..., None] * paint).sum(1) - seen).abs().mean().backward()
        optimiser.step()
    return s


def test_the_sharpness_is_never_stuck_and_never_outruns_the_samples(row: Row, scene: Scene) -> None:
    """s times the step between samples stays in [0.5, 50], and grows by a schedule and not by a gradient."""
    trainer = _trainer(scene)
    s, widths = [], []
    for i in range(101):
        sampling = sampling_at(i / 100, trainer.recipe, trainer.needs)
        s.append(sampling.sharpness)
        widths.append(sampling.sharpness * sampling.step)
    assert s == sorted(s) and s[-1] > s[0]
    assert 0.5 <= min(widths) and max(widths) <= 50
    learned, step = _learned_sharpness(scene, 2000), 2 / 64
    assert learned[-1] * step > 5 * max(widths)
    row(
        "sharpness over a fit",
        f"NeuS's, learned: {learned[0]:.0f} to {learned[-1]:.0f} in 2000 steps; times the step of 64 even samples {learned[-1] * step:.0f}",
        f"{s[0]:.0f} to {s[-1]:.0f}; s times the step from {min(widths):.1f} to {max(widths):.1f}",
    )


def _nerfacc_fit(opacity: float, steps: int) -> int:
    """A grid whose cells all have one opacity, learned where nerfacc samples: how many samples there were."""
    cells = torch.full((16**3,), opacity, requires_grad=True)
    optimiser, known, samples = torch.optim.Adam([cells], 1e-2), torch.zeros(16**3), 0
    for _ in range(steps):
        known = torch.maximum(0.95 * known, cells.detach())
        chosen = cells[nerfacc_keeps(known)]
        samples += len(chosen)
        optimiser.zero_grad()
        (chosen.sum() - 100).square().backward()
        optimiser.step()
    return samples


@pytest.mark.parametrize("state", [OUTSIDE, 200])
def test_a_grid_that_was_emptied_finds_the_scene_again(row: Row, scene: Scene, state: int) -> None:
    trainer = _trainer(scene, 60, **{"sampling.occupancy_every": 2})
    trainer.run_step()
    trainer.field.occupancy.states.fill_(state)
    while trainer.progress < 1:
        trainer.run_step()
    assert (trainer.field.occupancy.states == SHELL).any() and trainer.state.samples_total > 10_000 and trainer.state.bad_steps == 0
    opacity = 0.0 if state == OUTSIDE else 2.0**-10
    samples = _nerfacc_fit(opacity, 60)
    assert samples == 0 and _nerfacc_fit(0.1, 1) > 0
    row(
        f"an occupancy grid set to {'empty' if state == OUTSIDE else 'far from everything'}",
        f"nerfacc, opacity {opacity:.1g} in all cells: {samples} samples in 60 steps, so no gradient",
        "opens again within some steps",
    )


def _drawn(residual: np.ndarray, evenly: float, steps: int, rays: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of tiles of 32, of which each was looked at often, and the weights of their rays, (steps, rays) each.

    Args:
        residual: (N,) of each tile.
    """
    first_tile, count = torch.tensor([0, len(residual)], dtype=torch.int32), torch.full((len(residual),), TILE, dtype=torch.int32)
    ends, weight = odds(torch.from_numpy(residual.astype(np.float32)), count, first_tile, evenly)
    tile = torch.searchsorted(ends, torch.from_numpy(random.integers(0, 1 << 32, steps * rays)), right=True).numpy()
    pixel = TILE * tile + random.integers(0, TILE, len(tile))
    return pixel.reshape(steps, rays), weight.numpy()[tile].reshape(steps, rays)


def test_rays_that_follow_residuals_do_not_move_the_minimum(row: Row) -> None:
    """A picture, two of its 200 tiles a highlight, explained by one number: the least squared error is at the mean, wherever rays go."""
    random = np.random.default_rng(0)
    seen = np.where(np.arange(200 * TILE) // TILE % 100 == 0, 8.0, 0.3) + 0.05 * random.normal(size=200 * TILE)
    gradient = seen - seen.mean()  # of half the squared error, at the minimum: 0 on average
    pixel, weight = _drawn(np.abs(gradient).reshape(200, TILE).mean(1), 0.5, 2000, 400, random)
    usual, ours = gradient[pixel].mean(1), (weight * gradient[pixel]).mean(1)
    even = gradient[random.integers(len(seen), size=(2000, 400))].mean(1)
    bias = lambda steps: float(np.abs(steps.mean()) / (steps.std() / len(steps) ** 0.5))
    assert bias(ours) < 4 and bias(even) < 4 and bias(usual) > 100
    less = float(ours.std() / even.std())
    assert less < 0.5
    minimum = float((weight * seen[pixel]).sum() / weight.sum())
    assert minimum == pytest.approx(seen.mean(), rel=0.01)
    row(
        f"1% of the pixels a highlight, the mean {seen.mean():.3f}",
        f"drawn by residuals, not weighted, as instant-ngp: the minimum at {seen[pixel].mean():.2f}, {bias(usual):.0f} standard errors off",
        f"weighted: at {minimum:.3f}, {bias(ours):.1f} standard errors, {less:.2f} times the noise of even draws",
    )


def test_rays_are_bounded_where_residuals_are_out_of_date(row: Row) -> None:
    """A tile that fitted well until now and does not any more: rays that were seldom drawn must not weigh the more for it."""
    random = np.random.default_rng(1)
    known = np.where(np.arange(200) % 100 == 0, 8.0, 0.002)
    gradient = np.where(np.arange(200 * TILE) // TILE == 50, 1.0, 0.0)
    even = gradient[random.integers(len(gradient), size=(2000, 400))].mean(1)
    heaviest, noise = {}, {}
    for evenly in (1e-6, 0.5):
        pixel, weight = _drawn(known, evenly, 2000, 400, random)
        steps = (weight * gradient[pixel]).mean(1)
        assert abs(steps.mean() - gradient.mean()) < 4 * steps.std() / len(steps) ** 0.5
        heaviest[evenly], noise[evenly] = float(weight.max()), float(steps.std() / even.std())
    assert heaviest[1e-6] > 10 and noise[1e-6] > 3
    assert heaviest[0.5] <= 2.001 and noise[0.5] < 1.6
    row(
        "pixels that fitted well, and do not any more",
        f"drawn in proportion to residuals, weighted: weights up to {heaviest[1e-6]:.0f}, {noise[1e-6]:.1f} times the noise of even draws",
        f"half of the rays evenly: up to {heaviest[0.5]:.1f}, {noise[0.5]:.1f} times the noise",
    )


def test_cameras_in_their_places_do_not_walk_off(row: Row, scene: Scene) -> None:
    """The field learns from where cameras were put, and rays then only say noise: 60 steps of refinement."""
    trainer = _trainer(scene, **{"poses.views": "on", "poses.rig": "off"})
    refinement = trainer.refinement
    layout, prior = refinement.layout, refinement.prior
    frames, away = len(layout.poses), float(np.linalg.norm(layout.poses[:, :3, 3], axis=1).mean())
    equations = []

    def look(random: np.random.Generator) -> RayJacobian:
        frame = np.repeat(np.arange(frames), 90)
        across, local = random.normal(size=(len(frame), 3)), random.normal(size=(len(frame), 3)) * 0.3 + [0.0, 0.0, 1.0]
        ahead = np.einsum("nij,nj->ni", layout.poses[frame, :3, :3], local / np.linalg.norm(local, axis=1, keepdims=True))
        order = random.permutation(len(frame))
        rows = frame, 0.1 * random.normal(size=len(frame)), 5.0 * across, 5.0 * away * across, ahead
        found = RayJacobian(*(torch.from_numpy(x[order]) for x in rows))
        equations.append(poses.normal_equations([found], layout.poses))
        return found

    def pixels(motions: poses.Motions) -> float:
        return float(np.sqrt(np.einsum("vi,vij,vj->v", motions.views, layout.pixels[layout.anchor], motions.views).mean()))

    for _ in range(60):
        refinement.step(lambda _, count, random: (look(random) for _ in range(count)), 0.5)
    usual = poses.Motions(np.zeros_like(refinement.motions.views), refinement.motions.sensors)
    for found in equations:
        usual = poses.advance(layout, usual, poses.solve(found.of(0, 1), layout, usual, True, False, prior))
    row(
        "cameras in their places, noise in the rays",
        f"least squares of {len(equations)} looks: {pixels(usual):.2f} pixels off",
        f"{pixels(refinement.motions):.2f} pixels off",
    )
    # 0.026 where steps are as long as the other half of the rays confirms, sure or not
    assert pixels(usual) > 0.3 and pixels(refinement.motions) < 0.01


def test_cameras_before_a_small_object_are_put_in_their_places(row: Row, tmp_path: Path) -> None:
    """The ball is 2 % of each picture: rays that are drawn evenly say next to nothing of where cameras are."""
    true = load_scene(write_scene(tmp_path, {"rgb": around(16)}, size=(160, 120)))
    away = np.linalg.norm(true.frames[0].camera_to_world[:3, 3])
    unit = np.repeat([1.0, away], 3) / FOCAL / 2**0.5  # a pixel, root mean square of two axes
    off = poses.motion_to_matrix(unit * np.random.default_rng(4).normal(size=(len(true.frames), 6)))
    moved = (dataclasses.replace(f, camera_to_world=f.camera_to_world @ m) for f, m in zip(true.frames, off, strict=True))
    scene = dataclasses.replace(true, frames=tuple(moved))
    frames, points = true.frames_of("rgb", true.split.train), 0.5 * RADIUS * np.array([*np.eye(3), *-np.eye(3)])

    def picture_of(pose: np.ndarray) -> np.ndarray:
        seen = (points - pose[:3, 3]) @ pose[:3, :3]
        return FOCAL * seen[:, :2] / seen[:, 2:]

    def pixels(trainer: Trainer) -> float:
        now = poses.moved(trainer.refinement.layout, trainer.refinement.motions)
        now[:, :3, 3] = true.region.radius * now[:, :3, 3] + true.region.centre
        squares = [np.square(picture_of(p) - picture_of(f.camera_to_world)).sum(1).mean() for p, f in zip(now, frames, strict=True)]
        return float(np.mean(squares) ** 0.5)

    before, after = pixels(_trainer(scene)), {}
    for evenly in (1.0, QUICK.sampling.evenly):
        trainer = _trainer(scene, 300, **{"sampling.evenly": evenly})
        while trainer.progress < 1.0:
            trainer.run_step()
        after[evenly] = pixels(trainer)
    usual, ours = after.values()
    row(
        f"a ball that is 2% of each picture, cameras {before:.2f} pixels off",
        f"rays drawn evenly: {usual:.2f} pixels off after the fit",
        f"half of the rays where residuals are large: {ours:.2f}",
    )
    assert usual > 0.8 * before and ours < 0.6 * before
