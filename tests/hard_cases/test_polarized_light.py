"""Hard cases of linear polarization: what the usual formula does, and the bound that ours keeps."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from mmsynth.field import kernels
from mmsynth.field.kernels import intensity
from mmsynth.fitting.measurements import Batch
from mmsynth.sensors.mosaic import channel_map, demosaic, mosaic
from mmsynth.sensors.polarization import (
    analyser_axes,
    analyser_matrix,
    angle_of_linear_polarization,
    aolp_difference,
    aolp_mean,
    coherency_from_factor,
    coherency_to_stokes,
    degree_of_linear_polarization,
    flip_stokes,
    frame_angle,
    intensities_to_stokes,
    reference_axes,
    resample_stokes,
    rotate_stokes,
    stokes_to_coherency,
    stokes_to_intensities,
)

Row = Callable[[str, str, str], None]
ANGLES = (0.0, 45.0, 90.0, 135.0)
SIGN = 1.0


def _camera(pitch: float, roll: float) -> tuple[Tensor, Tensor, Tensor]:
    """Camera x, up and forward axes in a world whose z is up: pitch -90 looks at the nadir, roll is counter-clockwise."""
    p, r = math.radians(pitch), math.radians(roll)
    forward = torch.tensor([math.cos(p), 0.0, math.sin(p)], dtype=torch.float64)
    right, up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), torch.tensor([-math.sin(p), 0.0, math.cos(p)], dtype=torch.float64)
    return math.cos(r) * right + math.sin(r) * up, math.cos(r) * up - math.sin(r) * right, forward


def _rays(axes: tuple[Tensor, Tensor, Tensor], half_angle: float = 25.0) -> Tensor:
    right, up, forward = axes
    reach = math.tan(math.radians(half_angle))
    grid = torch.linspace(-reach, reach, 21, dtype=torch.float64)
    u, v = (g.reshape(-1, 1) for g in torch.meshgrid(grid, 0.75 * grid, indexing="ij"))
    return normalize(forward + u * right + v * up, dim=1)


def _worlds_frame(stokes: Tensor, directions: Tensor, up: Tensor) -> Tensor:
    """MultimodalStudio's: Stokes in the frame of the world's horizon → the camera's, by θ = acos(n·up) - π/2; of the two signs the
    one that is right for cameras rolled by less than a quarter."""
    return rotate_stokes(stokes, SIGN * _worlds_angle(directions, up))


def _worlds_angle(directions: Tensor, up: Tensor) -> Tensor:
    n = normalize(torch.linalg.cross(directions, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(directions)), dim=1)
    return torch.acos((n @ up).clamp(-1 + 1e-4, 1 - 1e-4)) - math.pi / 2


CAMERAS = [(0, 0), (-30, 30), (0, 90), (-20, 135), (-30, 180), (-89, 20), (-90, 0), (90, 45)]


@pytest.mark.parametrize(("pitch", "roll"), CAMERAS)
def test_cameras_turned_any_way(row: Row, pitch: float, roll: float) -> None:
    """Light polarized along a known vector, seen by level, portrait, upside-down, nadir and zenith cameras."""
    axes = _camera(pitch, roll)
    d = _rays(axes)
    light = normalize(torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64), dim=0).expand_as(d)
    light = normalize(light - (light * d).sum(1, keepdim=True) * d, dim=1)
    x, y = reference_axes(d, axes[0].expand_as(d))
    truth = torch.rad2deg(torch.atan2((light * y).sum(1), (light * x).sum(1)))
    j = light[:, :, None] * light[:, None, :]
    ours = aolp_difference(angle_of_linear_polarization(coherency_to_stokes(j, x, y)), truth).abs()
    behind = intensities_to_stokes(
        (
            analyser_axes(d, axes[0].expand_as(d), torch.deg2rad(torch.tensor([ANGLES], dtype=torch.float64)).expand(len(d), 4))
            * light[:, None]
        )
        .sum(-1)
        .square(),
        ANGLES,
    )
    ours = torch.maximum(ours, aolp_difference(angle_of_linear_polarization(behind), truth).abs())
    # the usual way: Stokes in the frame of the horizon, turned by an arc cosine; granting it the better sign
    n = torch.linalg.cross(d, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(d))
    steep = n.norm(dim=1, keepdim=True) < 1e-9
    n = torch.where(steep, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), normalize(n, dim=1))
    horizon = coherency_to_stokes(j, n, torch.linalg.cross(n, d))
    # judged in the frame that it means: x across the ray and image up
    right = normalize(torch.linalg.cross(d, axes[1].expand_as(d)), dim=1)
    meant = angle_of_linear_polarization(coherency_to_stokes(j, right, torch.linalg.cross(right, d)))
    usual = aolp_difference(angle_of_linear_polarization(_worlds_frame(horizon, d, axes[1])), meant).abs()
    assert ours.max() < 1e-6
    if (pitch, roll) == (0, 0):
        return  # where the usual way is right
    assert usual.max() > 0.5
    row(
        f"AoLP of a camera with pitch {pitch}°, roll {roll}°, 50° across",
        f"frame of the horizon and acos: mean {usual.mean():.2g}°, up to {usual.max():.2g}°",
        f"{max(float(ours.max()), 1e-15):.0e}°",
    )


def test_turning_a_camera_turns_what_it_sees(row: Row) -> None:
    """From roll to roll, signed: an arc cosine has no sign."""
    worst, usual = 0.0, {}
    for roll in range(0, 360, 5):
        (x0, up, forward), (x1, up1, _) = _camera(-20, 0), _camera(-20, roll)
        y0 = torch.linalg.cross(x0, forward)
        turn = torch.rad2deg(frame_angle(x0, y0, x1))
        assert (y0 - up).norm() < 1e-12
        worst = max(worst, abs((float(turn) - roll + 180) % 360 - 180))
        usual[roll] = float(aolp_difference(torch.rad2deg(_worlds_angle(forward[None], up1)), torch.tensor(float(roll))).abs())
    assert worst < 1e-9 and usual[30] < 1 and usual[135] > 80
    row(
        "angle between two cameras' frames",
        f"acos, without a sign: {usual[100]:.0f}° off at roll 100°, {usual[135]:.0f}° at 135°",
        f"signed, {worst:.0e}°",
    )


def test_degree_of_polarization_at_zero_has_a_gradient(row: Row) -> None:
    stokes = torch.tensor([[1.0, 0.0, 0.0]], requires_grad=True)
    (usual,) = torch.autograd.grad(torch.sqrt(stokes[:, 1] ** 2 + stokes[:, 2] ** 2).sum(), stokes)
    (ours,) = torch.autograd.grad(degree_of_linear_polarization(stokes).sum(), stokes)
    assert usual.isnan().any() and not ours.any()
    row("gradient of DoLP where there is no polarization", "√(S1² + S2²): NaN", "0")


def test_black_pixels_have_no_degree_of_polarization(row: Row) -> None:
    black = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1e-9, 0.0]])
    usual = black[:, 1:].norm(dim=1) / black[:, 0]
    assert usual[0].isnan() and usual[1].isinf()
    assert degree_of_linear_polarization(black).tolist() == [0.0, 0.0]
    row("DoLP of a black pixel", "division by S0: NaN, or infinite with noise", "0")


def test_light_is_never_more_than_polarized(row: Row) -> None:
    """Whatever six numbers the network gives, and from any side."""
    generator = torch.Generator().manual_seed(0)
    raw = 5 * torch.randn(5000, 6, generator=generator, dtype=torch.float64)
    factor = coherency_from_factor(raw)
    d = normalize(torch.randn(5000, 3, generator=generator, dtype=torch.float64), dim=1)
    frame = reference_axes(d, normalize(torch.randn(5000, 3, generator=generator, dtype=torch.float64), dim=1))
    ours = degree_of_linear_polarization(coherency_to_stokes(factor @ factor.mT, *frame))
    s0 = torch.nn.functional.leaky_relu(raw[:, 0], 0.01)
    usual, dark = raw[:, 1:3].norm(dim=1) / s0.abs(), float((0.5 * (s0 - raw[:, 1:3].norm(dim=1)) < 0).double().mean())
    assert usual.max() > 10 and dark > 0.5 and ours.max() <= 1 + 1e-9
    least = intensity(raw, analyser_axes(d, frame[0], torch.zeros(5000, dtype=torch.float64))).min()
    assert least >= 0
    row(
        "DoLP of what a network may answer",
        f"MultimodalStudio's three free numbers: up to {usual.max():.0f}, for {dark:.0%} some intensity is below 0",
        f"{ours.max():.6f} at most",
    )


def test_angles_are_averaged_as_directions(row: Row) -> None:
    angles = torch.tensor([89.0, -89.0, 88.0], dtype=torch.float64)
    usual, ours = aolp_difference(angles.mean(), torch.tensor(89.333)).abs(), aolp_difference(aolp_mean(angles), torch.tensor(89.333)).abs()
    assert usual > 50 and ours < 1e-2
    row("mean of AoLP 89°, -89°, 88°", f"of the numbers: {angles.mean():.0f}°", f"{aolp_mean(angles):.1f}°")


def test_angles_are_resampled_as_stokes(row: Row) -> None:
    """A ramp of angles through 90 degrees, sampled between its pixels."""
    truth = torch.linspace(70, 110, 9, dtype=torch.float64)
    stokes = torch.stack([torch.ones(9, dtype=torch.float64), torch.cos(torch.deg2rad(2 * truth)), torch.sin(torch.deg2rad(2 * truth))], -1)
    aolp = angle_of_linear_polarization(stokes)
    middle = (truth[1:] + truth[:-1]) / 2
    usual = aolp_difference((aolp[1:] + aolp[:-1]) / 2, middle).abs().max()
    ours = aolp_difference(angle_of_linear_polarization((stokes[1:] + stokes[:-1]) / 2), middle).abs().max()
    assert usual > 80 and ours < 1e-9
    row("AoLP between two pixels, across 90°", f"of the angles: {usual:.0f}° off", f"of Stokes vectors: {max(float(ours), 1e-15):.0e}°")


def test_flipped_pictures_keep_their_angles(row: Row) -> None:
    stokes = torch.tensor([[1.0, 0.3, 0.5]], dtype=torch.float64)
    expected = -angle_of_linear_polarization(stokes)
    usual = aolp_difference(angle_of_linear_polarization(stokes), expected).abs()
    ours = aolp_difference(angle_of_linear_polarization(flip_stokes(stokes)), expected).abs()
    assert usual > 30 and ours < 1e-12
    row("AoLP in a mirrored picture", f"pixels moved alone: {float(usual):.0f}° off", "S2 changes its sign: 0°")


def _batch(target: list[float], saturation: float) -> Batch:
    """One ray behind four analysers."""
    d, x = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    axes = analyser_axes(d, x, torch.deg2rad(torch.tensor([ANGLES])))[0]
    four, zeros = torch.ones(4), torch.zeros(4, dtype=torch.int64)
    return Batch(
        origins=torch.zeros(1, 3), directions=d,
        measured=kernels.Measured(torch.tensor(target), zeros, zeros, axes, four, saturation * four, 0.25 * four),
        frame=zeros, parts={"pol": (slice(0, 1), slice(0, 4))}, alpha=torch.full((1,), torch.nan), ray_weight=torch.ones(1),
        jitter=torch.zeros(1), tile=zeros[:1],
    )  # fmt: skip


def test_saturated_photosites_say_at_least(row: Row) -> None:
    """Bright polarized light clips behind one analyser: the others still tell what it is."""
    truth = torch.tensor([1.6, 1.2, 0.0])
    measured = stokes_to_intensities(truth, ANGLES).clamp(max=1.0)
    usual = degree_of_linear_polarization(intensities_to_stokes(measured, ANGLES))
    batch = _batch(measured.tolist(), 1.0)
    raw = torch.tensor([[1.0, 1.0, -2.0, 0.0, 0.0, 0.0]], requires_grad=True)
    optimiser = torch.optim.Adam([raw], 0.02)
    for _ in range(1500):
        optimiser.zero_grad()
        kernels.photometric(
            kernels.residual(kernels.predict(raw, torch.ones(1), batch.measured), batch.measured), batch.measured
        ).backward()
        optimiser.step()
    factor = coherency_from_factor(raw.detach())[0]
    ours = coherency_to_stokes(factor @ factor.mT, torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, -1.0, 0.0]))
    # I0 is clipped; I90, I45 = I135 leave S0 ≥ 1.6 · 0.5 · 2: what is known, I45 + I135 = S0, is met
    assert float(ours[0]) == pytest.approx(1.6, abs=0.02) and float(degree_of_linear_polarization(ours)) == pytest.approx(0.75, abs=0.02)
    assert abs(float(usual) - 0.75) > 0.1
    row(
        "I0 clipped, DoLP 0.75",
        f"Stokes of the clipped values: {float(usual):.2f}",
        f"learned, clipped says at least: {float(degree_of_linear_polarization(ours)):.2f}",
    )


def test_black_photosites_pull_no_harder_than_others(row: Row) -> None:
    """All four zero: the fit goes dark, and every gradient on the way is finite."""
    batch = _batch([0.0] * 4, 1.0)
    raw = torch.zeros(1, 6, requires_grad=True)
    for _ in range(300):
        loss = kernels.photometric(kernels.residual(kernels.predict(raw, torch.ones(1), batch.measured), batch.measured), batch.measured)
        (gradient,) = torch.autograd.grad(loss, raw)
        assert torch.isfinite(gradient).all()
        raw = (raw - 0.5 * gradient).detach().requires_grad_()
    assert float(loss.detach()) < 0.01
    black = torch.zeros(3, requires_grad=True)
    (0.5 * torch.atan2(black[2], black[1]) + torch.sqrt(black[1] ** 2 + black[2] ** 2) / black[0]).backward()
    lost = int(black.grad.isnan().sum())
    assert lost == 3
    row(
        "a polarization pixel that is black",
        f"AoLP and DoLP in the loss: gradient NaN for {lost} of 3 Stokes parameters",
        f"intensities in the loss: every gradient finite, loss {float(loss.detach()):.0e}",
    )


def test_stokes_of_transverse_light_round_trip_at_the_poles(row: Row) -> None:
    """No world axis is special: rays along ±z, ±x, ±y."""
    d = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    x = torch.roll(d, 1, 1)
    stokes = torch.tensor([[1.0, 0.3, -0.6]], dtype=torch.float64).expand(6, 3)
    frame = reference_axes(d, x)
    error = (coherency_to_stokes(stokes_to_coherency(stokes, *frame), *frame) - stokes).abs().max()
    n = torch.linalg.cross(d, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(d))
    lost = int((n / n.norm(dim=1, keepdim=True)).isnan().any(1).sum())
    assert error < 1e-12 and lost == 2
    row("rays along the world's z axis", f"no horizon: NaN for {lost} of 6 axes", f"{max(float(error), 1e-16):.0e}")


def test_eight_bits_are_too_few_for_dim_polarization(row: Row) -> None:
    """3 % of full scale, DoLP 0.05: why files are 16 bit and float."""
    random = np.random.default_rng(0)
    psi = random.uniform(0, np.pi, 4000)
    truth = torch.from_numpy(0.06 * np.stack([np.ones(4000), 0.05 * np.cos(2 * psi), 0.05 * np.sin(2 * psi)], -1))
    errors = {}
    for bits in (8, 16):
        steps = 2**bits - 1
        stored = torch.round(stokes_to_intensities(truth, ANGLES) * steps) / steps
        found = angle_of_linear_polarization(intensities_to_stokes(stored, ANGLES))
        errors[bits] = float(aolp_difference(found, angle_of_linear_polarization(truth)).abs().mean())
    assert errors[8] > 5 and errors[16] < 0.1
    row("AoLP of dim light (3 %, DoLP 0.05) in a file", f"8 bits: {errors[8]:.0f}°", f"16 bits: {errors[16]:.2f}°")


def test_order_of_the_analysers(row: Row) -> None:
    """IMX250MZR: 90, 45 / 135, 0, row by row. 0, 45 / 135, 90 is in circulation, too."""
    psi = torch.linspace(0, math.pi, 181, dtype=torch.float64)[:-1]
    stokes = torch.stack([torch.ones_like(psi), 0.4 * torch.cos(2 * psi), 0.4 * torch.sin(2 * psi)], -1)
    sensor, other = np.array([[2, 1], [3, 0]]), np.array([[0, 1], [3, 2]])
    raw = mosaic(stokes_to_intensities(stokes, ANGLES).T[:, None].repeat(1, 2, 1).repeat_interleave(2, 2), sensor)  # a tile for each angle

    def error(pattern: np.ndarray) -> Tensor:
        channel = torch.from_numpy(channel_map(pattern, 2, 2).astype(np.int64)).flatten()
        tiles = raw.reshape(2, len(psi), 2).movedim(1, 0).reshape(-1, 4)
        found = angle_of_linear_polarization(intensities_to_stokes(tiles[:, channel.argsort()], ANGLES))
        return aolp_difference(found, angle_of_linear_polarization(stokes)).abs()

    assert error(sensor).max() < 1e-9 and error(other).max() > 89
    row(
        "analysers of a mosaic in another order, 0, 45 / 135, 90",
        f"AoLP: mean {error(other).mean():.0f}°, up to {error(other).max():.0f}° off",
        f"the pattern is the sensor's own: {max(float(error(sensor).max()), 1e-15):.0e}°",
    )


def test_an_edge_is_not_polarized(row: Row) -> None:
    """Unpolarized light, dark on one side: analysers at neighbouring photosites see different sides of it."""
    pattern, left = np.array([[2, 1], [3, 0]]), torch.arange(15).repeat(16, 1) < 7
    stokes = torch.where(left, 1.0, 0.2).double()[..., None] * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    raw = mosaic(stokes_to_intensities(stokes, ANGLES).movedim(-1, 0), pattern)
    usual = degree_of_linear_polarization(intensities_to_stokes(demosaic(raw, pattern).movedim(0, -1), ANGLES))
    # every photosite compared with its own analyser, as in a fit: least squares for the light of each side
    rows = analyser_matrix(ANGLES)[torch.from_numpy(channel_map(pattern, *left.shape).astype(np.int64))]
    rows = torch.cat([rows * left[..., None], rows * ~left[..., None]], -1).reshape(-1, 6)
    found = torch.linalg.lstsq(rows, raw.reshape(-1, 1)).solution.reshape(2, 3)
    ours = degree_of_linear_polarization(found).max()
    assert usual.max() > 0.2 and ours < 1e-9
    row(
        "DoLP of unpolarized light at an edge, 1 to 0.2",
        f"of a demosaicked picture: up to {usual.max():.2f}",
        f"of what explains the raw photosites: {max(float(ours), 1e-16):.0e}",
    )


def test_analysers_stand_tilted_in_rays_from_the_side(row: Row) -> None:
    """Korger's analysers, 50 degrees across, taken as if each ray met them at their nominal angles."""
    x, up, forward = _camera(-20, 30)
    d = _rays((x, up, forward))
    angles = torch.deg2rad(torch.tensor([ANGLES], dtype=torch.float64)).expand(len(d), 4)
    e = analyser_axes(d, x.expand_as(d), angles, "korger", forward.expand_as(d))
    psi = torch.linspace(0, math.pi, len(d), dtype=torch.float64)
    stokes = torch.stack([torch.ones_like(psi), 0.3 * torch.cos(2 * psi), 0.3 * torch.sin(2 * psi)], -1)
    frame = reference_axes(d, x.expand_as(d))
    measured = torch.einsum("nki,nij,nkj->nk", e, stokes_to_coherency(stokes, *frame), e)
    truth = angle_of_linear_polarization(stokes)
    usual = aolp_difference(angle_of_linear_polarization(intensities_to_stokes(measured, ANGLES)), truth).abs()
    turned = 2 * frame_angle(frame[0][:, None], frame[1][:, None], e)
    rows = 0.5 * torch.stack([torch.ones_like(turned), torch.cos(turned), torch.sin(turned)], -1)
    ours = aolp_difference(angle_of_linear_polarization(torch.linalg.lstsq(rows, measured[..., None]).solution[..., 0]), truth).abs()
    assert usual.max() > 3 and ours.max() < 1e-9
    row(
        "AoLP behind analysers that stand tilted in rays, 50° across",
        f"nominal angles: mean {usual.mean():.1f}°, up to {usual.max():.1f}°",
        f'axes by `off_axis="korger"`: {ours.max():.0e}° (fits take nominal angles)',
    )


def test_noise_alone_looks_polarized(row: Row) -> None:
    """Weak polarization in noise of half its size: a length is never negative, so its mean is too large."""
    generator = torch.Generator().manual_seed(0)
    truth, sd = torch.tensor([1.0, 0.04, 0.0], dtype=torch.float64), 0.02 / 2**0.5
    noisy = stokes_to_intensities(truth, ANGLES) + sd * torch.randn(100_000, 4, generator=generator, dtype=torch.float64)
    stokes = intensities_to_stokes(noisy, ANGLES)
    usual, ours = (float(degree_of_linear_polarization(stokes, noise).mean()) - 0.04 for noise in (0.0, sd))
    assert usual > 3e-3 and abs(ours) < usual / 3
    row("mean DoLP of 0.04 in noise of 0.02", f"√(S1² + S2²) / S0: {usual:+.4f}", f"without the bias of the noise: {ours:+.4f}")


def test_pictures_resampled_into_another_camera(row: Row) -> None:
    """The same rays in a camera rolled by 30 degrees: pixels that are moved alone keep the angles of the camera that they come from."""
    one, other = _camera(-20, 0), _camera(-20, 30)
    d = _rays(one)
    light = torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64).expand_as(d)
    light = normalize(light - (light * d).sum(1, keepdim=True) * d, dim=1)
    frames = [reference_axes(d, camera[0].expand_as(d)) for camera in (one, other)]
    before, truth = (coherency_to_stokes(light[:, :, None] * light[:, None, :], *frame) for frame in frames)
    pixels = torch.stack(torch.meshgrid(torch.arange(21.0), torch.arange(21.0), indexing="xy"), -1).double()[None]
    turn = frame_angle(*frames[0], frames[1][0]).reshape(1, 21, 21)
    found = resample_stokes(before.T.reshape(1, 3, 21, 21), pixels, turn)[0].flatten(1).T
    usual, ours = (
        aolp_difference(angle_of_linear_polarization(s), angle_of_linear_polarization(truth)).abs().max() for s in (before, found)
    )
    assert usual > 25 and ours < 1e-6
    row(
        "a picture resampled into a camera rolled by 30°",
        f"pixels moved alone: AoLP up to {usual:.0f}° off",
        f"{max(float(ours), 1e-15):.0e}°",
    )
