"""Polarization against closed forms, polanalyser and Mitsuba."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mmsynth.sensors.polarization import (
    OffAxis,
    analyser_axes,
    analyser_matrix,
    angle_of_linear_polarization,
    aolp_difference,
    aolp_mae,
    aolp_mean,
    aolp_sd,
    closure,
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

ANGLES = (0.0, 45.0, 90.0, 135.0)
MODELS: tuple[OffAxis, ...] = ("ideal", "lens", "korger")
ANGLE = st.floats(-720.0, 720.0)


def _stokes(*shape: int, seed: int = 0) -> Tensor:
    """Physical light: DoLP < 1."""
    generator = torch.Generator().manual_seed(seed)
    s0, p, psi = (torch.rand(shape, generator=generator, dtype=torch.float64) for _ in range(3))
    return torch.stack([s0 + 0.1, (s0 + 0.1) * p * torch.cos(7 * psi), (s0 + 0.1) * p * torch.sin(7 * psi)], -1)


def _cameras(count: int, half_angle: float, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Rays within a cone, camera x and z axes, of cameras turned every way (nadir, zenith, portrait among them)."""
    generator = torch.Generator().manual_seed(seed)
    q = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)).Q
    q = q * torch.linalg.det(q)[:, None, None]
    tilt, around = (
        half_angle * torch.rand(count, generator=generator, dtype=torch.float64),
        torch.linspace(0, 40, count, dtype=torch.float64),
    )
    local = torch.stack([torch.sin(tilt) * torch.cos(around), torch.sin(tilt) * torch.sin(around), torch.cos(tilt)], -1)
    return (q @ local[..., None])[..., 0], q[:, :, 0], q[:, :, 2]


# --- analysers


def test_axes_on_the_optical_axis_are_right_and_up() -> None:
    forward, right = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    x, y = reference_axes(forward, right)
    torch.testing.assert_close(x, right)
    torch.testing.assert_close(y, torch.tensor([[0.0, -1.0, 0.0]]))  # OpenCV: y is down, so up is -y


@pytest.mark.parametrize("model", MODELS)
def test_malus(model: OffAxis) -> None:
    """Fully polarized light at 30 degrees behind analysers of a camera rolled by any angle."""
    for roll in np.radians([0.0, 40.0, 100.0, 135.0, 180.0, 270.0]):
        right = torch.tensor([[math.cos(roll), -math.sin(roll), 0.0]])
        forward = torch.tensor([[0.0, 0.0, 1.0]])
        axes = analyser_axes(forward, right, torch.deg2rad(torch.tensor([ANGLES])), model, forward)
        light = torch.tensor([math.cos(math.radians(30)), -math.sin(math.radians(30)), 0.0])
        stokes = intensities_to_stokes((axes @ light).square()[0], ANGLES)
        expected = torch.tensor(30.0 - math.degrees(roll))  # rolling the camera counter-clockwise turns AoLP back
        assert aolp_difference(angle_of_linear_polarization(stokes), expected).abs() < 1e-4
        assert degree_of_linear_polarization(stokes) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("half_angle", [1e-5, 0.5, 1.2])
def test_analysers_are_unit_vectors_across_the_ray_that_agree_on_the_axis(model: OffAxis, half_angle: float) -> None:
    d, x, z = _cameras(300, half_angle)
    angles = torch.deg2rad(torch.tensor(ANGLES, dtype=torch.float64)).expand(300, 4)
    e = analyser_axes(d, x, angles, model, z)
    assert (e * d[:, None]).sum(-1).abs().max() < 1e-12
    torch.testing.assert_close(e.norm(dim=-1), torch.ones(300, 4, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(analyser_axes(d, x, angles[:, 1], model, z), e[:, 1])
    difference = e - analyser_axes(d, x, angles, "ideal")
    assert difference.abs().max() < 2 * half_angle**2  # of second order in the distance from the axis


def test_korgers_analyser_absorbs_along_its_absorbing_axis() -> None:
    d, x, z = _cameras(200, 1.2)
    up = torch.linalg.cross(x, z)
    e = analyser_axes(d, x, torch.full((200, 1), math.radians(30), dtype=torch.float64), "korger", z)[:, 0]
    absorbing = math.cos(math.radians(120)) * x + math.sin(math.radians(120)) * up
    assert (e * absorbing).sum(-1).abs().max() < 1e-12


def test_a_symmetric_lens_keeps_the_axes_orthogonal() -> None:
    """Analysers 90 degrees apart stay so: no DoLP error, as anchors of the lens model say; tilted ones do not."""
    d, x, z = _cameras(200, 1.0)
    angles = torch.deg2rad(torch.tensor([20.0, 110.0], dtype=torch.float64)).expand(200, 2)
    lens, korger = (analyser_axes(d, x, angles, model, z) for model in ("lens", "korger"))
    assert (lens[:, 0] * lens[:, 1]).sum(-1).abs().max() < 1e-12
    assert (korger[:, 0] * korger[:, 1]).sum(-1).abs().max() > 0.05
    with pytest.raises(ValueError, match="optical axes"):
        analyser_axes(d, x, angles, "korger")


def test_extinction_and_throughput() -> None:
    """An analyser with ER = 30 passes t·30/31 of what is along it and t/31 of what is across."""
    along, across = torch.tensor([1.0, 1.0, 0.0]), torch.tensor([1.0, -1.0, 0.0])
    assert float(stokes_to_intensities(along, [0.0], 0.8, 30.0)) == pytest.approx(0.8 * 30 / 31)
    assert float(stokes_to_intensities(across, [0.0], 0.8, 30.0)) == pytest.approx(0.8 / 31)
    torch.testing.assert_close(analyser_matrix(ANGLES), analyser_matrix(ANGLES, 1.0, [math.inf] * 4))
    # DoLP that is seen as if the analysers were ideal: x (ER - 1) / (ER + 1)
    full = torch.tensor([1.0, 0.6, 0.8], dtype=torch.float64)
    naive = intensities_to_stokes(stokes_to_intensities(full, ANGLES, 1.0, 30.0), ANGLES)
    assert float(degree_of_linear_polarization(naive)) == pytest.approx(29 / 31)


@settings(max_examples=30, deadline=None)
@given(count=st.integers(3, 8), ratio=st.floats(2, 1000), throughput=st.floats(0.1, 1), first=ANGLE, seed=st.integers(0, 99))
def test_stokes_come_back_from_any_analysers(count: int, ratio: float, throughput: float, first: float, seed: int) -> None:
    angles = [first + 180.0 * i / count for i in range(count)]
    stokes = _stokes(20, seed=seed)
    back = intensities_to_stokes(stokes_to_intensities(stokes, angles, throughput, ratio), angles, throughput, ratio)
    torch.testing.assert_close(back, stokes, atol=1e-10, rtol=0)


def test_stokes_equal_polanalyser() -> None:
    oracle = pytest.importorskip("polanalyser")
    stokes = _stokes(5, 6)
    intensities = stokes_to_intensities(stokes, ANGLES)
    images = [intensities[..., i].numpy() for i in range(4)]
    theirs = oracle.calcStokes(images, [oracle.polarizer(np.radians(a))[:3, :3] for a in ANGLES])
    np.testing.assert_allclose(theirs[..., :3], stokes, atol=1e-6)
    np.testing.assert_allclose(degree_of_linear_polarization(stokes), oracle.cvtStokesToDoLP(stokes.numpy()), atol=1e-9)
    aolp = torch.from_numpy(np.degrees(oracle.cvtStokesToAoLP(stokes.numpy())))
    assert aolp_difference(angle_of_linear_polarization(stokes), aolp).abs().max() < 1e-6
    turned = rotate_stokes(stokes, torch.tensor(0.3, dtype=torch.float64))
    np.testing.assert_allclose(turned, stokes.numpy() @ oracle.rotator(0.3)[:3, :3].T, atol=1e-12)


def test_closure_is_zero_of_light_and_noise_of_noise() -> None:
    stokes = _stokes(4000)
    intensities = stokes_to_intensities(stokes, ANGLES)
    assert closure(intensities, ANGLES).shape == (4000, 1) and closure(intensities, ANGLES).abs().max() < 1e-12
    noisy = intensities + 0.01 * torch.randn(4000, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert float(closure(noisy, ANGLES).std()) == pytest.approx(0.01, rel=0.05)
    i0, i45, i90, i135 = noisy.unbind(-1)
    torch.testing.assert_close(closure(noisy, ANGLES)[:, 0], 0.5 * (i0 - i45 + i90 - i135))
    assert closure(intensities[..., [1, 0, 2, 3]], ANGLES).abs().mean() > 0.01  # wrong order
    assert closure(intensities**1.1, ANGLES).abs().mean() > 1e-3  # not linear
    assert closure(noisy[:, :3], ANGLES[:3]).shape == (4000, 0)  # three analysers explain anything


# --- coherency tensors and frames


def test_coherency_is_physical_for_any_factor_and_frame() -> None:
    factor = coherency_from_factor(torch.randn(200, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 3)
    j, (d, x, _) = factor @ factor.mT, _cameras(200, 1.2)
    axes = analyser_axes(d, x, torch.deg2rad(torch.tensor([ANGLES], dtype=torch.float64).expand(200, 4)))
    intensities = (axes @ factor).square().sum(-1)
    assert intensities.min() >= 0
    stokes = coherency_to_stokes(j, *reference_axes(d, x))
    torch.testing.assert_close(intensities_to_stokes(intensities, ANGLES), stokes, atol=1e-9, rtol=0)
    assert degree_of_linear_polarization(stokes).max() <= 1 + 1e-9


def test_coherency_and_stokes_round_trip_and_transverse() -> None:
    stokes, (d, x, _) = _stokes(100), _cameras(100, 1.2)
    frame = reference_axes(d, x)
    j = stokes_to_coherency(stokes, *frame)
    torch.testing.assert_close(coherency_to_stokes(j, *frame), stokes, atol=1e-12, rtol=0)
    assert (j @ d[..., None]).abs().max() < 1e-12 and torch.linalg.eigvalsh(j).min() > -1e-12


@settings(max_examples=50, deadline=None)
@given(angle=ANGLE, seed=st.integers(0, 99))
def test_turning_the_frame_is_turning_the_axes(angle: float, seed: int) -> None:
    stokes, (d, x, _) = _stokes(20, seed=seed), _cameras(20, 1.2, seed)
    x, y = reference_axes(d, x)
    turn = torch.deg2rad(torch.full((20,), angle, dtype=torch.float64))
    to_x = torch.cos(turn)[:, None] * x + torch.sin(turn)[:, None] * y
    to_y = torch.linalg.cross(to_x, d)
    assert (torch.remainder(frame_angle(x, y, to_x) - turn + math.pi, 2 * math.pi) - math.pi).abs().max() < 1e-9
    turned = rotate_stokes(stokes, turn)
    torch.testing.assert_close(turned, coherency_to_stokes(stokes_to_coherency(stokes, x, y), to_x, to_y), atol=1e-10, rtol=0)
    torch.testing.assert_close(degree_of_linear_polarization(turned), degree_of_linear_polarization(stokes), atol=1e-12, rtol=0)
    angles = angle_of_linear_polarization(stokes) - angle
    strong = degree_of_linear_polarization(stokes) > 1e-3
    assert aolp_difference(angle_of_linear_polarization(turned), angles)[strong].abs().max() < 1e-6
    torch.testing.assert_close(rotate_stokes(turned, -turn), stokes, atol=1e-12, rtol=0)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirrored_picture_has_mirrored_angles(axis: int) -> None:
    """The analyser at θ of the mirrored camera is the one at -θ of the camera."""
    stokes = _stokes(4, 5)
    mirrored = flip_stokes(stokes.flip(axis))
    torch.testing.assert_close(
        stokes_to_intensities(mirrored, (0.0, 30.0, 90.0)), stokes_to_intensities(stokes, (0.0, -30.0, 90.0)).flip(axis), atol=1e-12, rtol=0
    )


def test_a_picture_turned_by_a_quarter_has_angles_turned_by_a_quarter() -> None:
    """np.rot90 turns a picture counter-clockwise: what pointed right points up."""
    stokes = _stokes(4, 4)
    turned = rotate_stokes(torch.rot90(stokes, 1), torch.tensor(-math.pi / 2, dtype=torch.float64))
    expected = torch.rot90(angle_of_linear_polarization(stokes), 1) + 90.0
    assert aolp_difference(angle_of_linear_polarization(turned), expected).abs().max() < 1e-9


def test_a_rolled_camera_sees_the_same_light() -> None:
    """A camera turned by 30 degrees about its axis: pictures of one field of light, one resampled into the other."""
    turn, n = math.radians(30.0), 41
    axis = torch.arange(n, dtype=torch.float64) - (n - 1) / 2
    v, u = torch.meshgrid(axis, axis, indexing="ij")

    def light(right: Tensor, up: Tensor) -> Tensor:
        """(..., 3) of a frame along right and up, smooth in space."""
        psi, p = 0.02 * right + 0.01 * up, 0.4 + 0.005 * right
        return torch.stack([torch.ones_like(psi), p * torch.cos(2 * psi), p * torch.sin(2 * psi)], -1)

    level = light(u, -v)
    # the second camera's x axis stands at `turn`, from right towards up: its pixels (u, v) look at
    right, up = u * math.cos(turn) + v * math.sin(turn), u * math.sin(turn) - v * math.cos(turn)
    expected = rotate_stokes(light(right, up), torch.tensor(turn, dtype=torch.float64))
    pixels = torch.stack([right, -up], -1) + (n - 1) / 2
    found = resample_stokes(level.movedim(-1, 0)[None], pixels[None], torch.full((1, n, n), turn, dtype=torch.float64))[0].movedim(0, -1)
    inside = ((pixels >= 0) & (pixels <= n - 1)).all(-1)
    assert 0.6 < inside.double().mean() < 0.95
    torch.testing.assert_close(found[inside], expected[inside], atol=1e-3, rtol=0)
    outside = ((pixels < -1) | (pixels > n)).any(-1)
    assert not found[outside].any()
    moved_alone = aolp_difference(angle_of_linear_polarization(found), angle_of_linear_polarization(light(right, up)))[inside]
    assert (moved_alone.abs() - 30.0).abs().max() < 0.5  # what is not turned is off by the roll
    angle = torch.zeros(1, 3, 3, dtype=torch.float64, requires_grad=True)
    small = torch.rand(1, 3, 4, 5, dtype=torch.float64, requires_grad=True)
    where = (torch.rand(1, 3, 3, 2, dtype=torch.float64) * 2.7 + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(resample_stokes, (small, where, angle))


def test_resampling_equals_opencv() -> None:
    image = torch.rand(1, 3, 12, 17)
    pixels = torch.rand(1, 9, 8, 2) * torch.tensor([16.0, 11.0])
    ours = resample_stokes(image, pixels, torch.zeros(1, 9, 8))[0]
    theirs = cv2.remap(image[0].movedim(0, -1).numpy(), pixels[0].numpy(), None, cv2.INTER_LINEAR)
    np.testing.assert_allclose(ours.movedim(0, -1), theirs, atol=0.03)  # OpenCV rounds where it looks to 1/32 pixel


# --- degree and angle


def _noisy(p: float, sd: float) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    light = torch.tensor([1.0, p, 0.0], dtype=torch.float64).expand(40000, 3)
    return intensities_to_stokes(
        stokes_to_intensities(light, ANGLES) + sd * torch.randn(40000, 4, generator=generator, dtype=torch.float64), ANGLES
    )


def test_noise_polarizes_less_once_its_bias_is_taken_out() -> None:
    """Above the noise the bias is gone; of light without polarization, whose DoLP is Rayleigh's, e^(-1/2) of it is left."""
    stokes = _noisy(0.2, 0.02)
    raw, clean = degree_of_linear_polarization(stokes), degree_of_linear_polarization(stokes, 0.02)
    assert float(raw.mean()) - 0.2 > 1.5e-3 and abs(float(clean.mean()) - 0.2) < 3e-4
    stokes = _noisy(0.0, 0.02)
    raw, clean = degree_of_linear_polarization(stokes), degree_of_linear_polarization(stokes, 0.02)
    assert float(raw.mean()) == pytest.approx(math.sqrt(math.pi / 2) * math.sqrt(2) * 0.02, rel=0.02)
    assert float(clean.mean() / raw.mean()) == pytest.approx(math.exp(-0.5), rel=0.02)


def test_the_spread_of_angles_follows_the_noise() -> None:
    angles = angle_of_linear_polarization(_noisy(0.2, 0.005))
    expected = aolp_sd(torch.tensor([1.0, 0.2, 0.0], dtype=torch.float64), 0.005)
    assert float(aolp_difference(angles, torch.zeros_like(angles)).std()) == pytest.approx(float(expected), rel=0.02)


def test_circular_statistics() -> None:
    a, b = torch.tensor([89.0, -89.0, 0.0, 45.0]), torch.tensor([-89.0, 89.0, 180.0, -45.0])
    torch.testing.assert_close(aolp_difference(a, b), torch.tensor([-2.0, 2.0, 0.0, -90.0]))
    assert float(aolp_mean(torch.tensor([88.0, -88.0]))) == pytest.approx(90.0) or float(
        aolp_mean(torch.tensor([88.0, -88.0]))
    ) == pytest.approx(-90.0)
    assert float(aolp_mean(torch.tensor([10.0, 50.0, 20.0]), torch.tensor([1.0, 0.0, 1.0]))) == pytest.approx(15.0, abs=1e-4)
    assert torch.isnan(aolp_mean(torch.tensor([0.0, 90.0], dtype=torch.float64)))  # no direction
    assert float(aolp_mae(a, b, torch.tensor([1.0, 1.0, 2.0, 0.0]))) == pytest.approx(1.0)


@given(a=ANGLE, b=ANGLE, turns=st.integers(-4, 4))
def test_differences_of_angles_are_small_signed_and_periodic(a: float, b: float, turns: int) -> None:
    one, other = torch.tensor(a, dtype=torch.float64), torch.tensor(b, dtype=torch.float64)
    d = float(aolp_difference(one, other))
    assert -90.0 <= d <= 90.0
    assert math.cos(math.radians(2 * d)) == pytest.approx(math.cos(math.radians(2 * (a - b))), abs=1e-9)
    assert math.cos(math.radians(2 * float(aolp_difference(one + 180 * turns, other)))) == pytest.approx(
        math.cos(math.radians(2 * d)), abs=1e-9
    )


def test_no_light_has_no_polarization_and_no_gradient() -> None:
    stokes = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-0.1, 0.2, 0.0]], requires_grad=True)
    for sd in (0.0, 0.01):
        degree = degree_of_linear_polarization(stokes, sd)
        assert degree.tolist() == [0.0, 0.0, 0.0]
        (gradient,) = torch.autograd.grad(degree.sum(), stokes)
        assert torch.isfinite(gradient).all()


def test_gradients() -> None:
    stokes = _stokes(5).requires_grad_()
    angle = torch.rand(5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotate_stokes, (stokes, angle))
    assert torch.autograd.gradcheck(lambda s: degree_of_linear_polarization(s, 0.01), stokes)
    d, x, z = (t.requires_grad_() for t in _cameras(5, 0.6))
    for model in MODELS:
        assert torch.autograd.gradcheck(lambda *v, m=model: analyser_axes(v[0], v[1], v[3][:, None], m, v[2]), (d, x, z, angle))


# --- Mitsuba


def _mitsuba(variant: str = "scalar_spectral_polarized"):  # type: ignore[no-untyped-def]
    mi = pytest.importorskip("mitsuba")
    mi.set_variant(variant)
    return mi


@pytest.mark.oracle
def test_turned_frames_equal_mitsubas() -> None:
    mi = _mitsuba()
    stokes, (d, x, _) = _stokes(20), _cameras(20, 1.2)
    x, y = reference_axes(d, x)
    turn = torch.linspace(-3, 3, 20, dtype=torch.float64)
    to_x = torch.cos(turn)[:, None] * x + torch.sin(turn)[:, None] * y
    ours = rotate_stokes(stokes, frame_angle(x, y, to_x))
    for i in range(20):
        # the light comes towards the camera: it travels against the ray
        matrix = np.array(mi.mueller.rotate_stokes_basis(*(mi.Vector3f(v[i].tolist()) for v in (-d, x, to_x))))
        matrix = matrix if matrix.ndim == 2 else matrix[..., 0]
        np.testing.assert_allclose((matrix @ [*stokes[i].tolist(), 0.0])[:3], ours[i], atol=1e-6)


@pytest.mark.oracle
@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
def test_a_tilted_polarizer_equals_mitsubas(angle_deg: float) -> None:
    """Korger's model: unpolarized light through Mitsuba's polarizer, at rays up to 60 degrees off the axis, is polarized along e."""
    mi = _mitsuba()
    bsdf = mi.load_dict({"type": "polarizer", "theta": {"type": "spectrum", "value": angle_deg}})
    si = mi.SurfaceInteraction3f()
    for tilt, around in ((0.0, 0.0), (0.3, 1.0), (0.6, 2.5), (1.0, 4.0), (1.0, 5.5)):
        # the plate's frame: x, y across, light travels along -z to a camera that looks along +z with its x axis along x
        towards = np.array([math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)])
        si.wi = mi.Vector3f((-towards).tolist())  # the viewer's side; a ray of the camera goes on along `towards`
        _, weight = bsdf.sample(mi.BSDFContext(), si, 0.5, mi.Point2f(0.5, 0.5))
        matrix = np.array(weight)
        matrix = matrix if matrix.ndim == 2 else matrix[..., 0]
        out = matrix @ [1.0, 0.0, 0.0, 0.0]
        basis = np.array(mi.mueller.stokes_basis(mi.Vector3f((-towards).tolist())))
        d, x, z = (torch.tensor([v], dtype=torch.float64) for v in (towards.tolist(), [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
        e = analyser_axes(d, x, torch.tensor([[math.radians(angle_deg)]], dtype=torch.float64), "korger", z)[0, 0].numpy()
        across = np.cross(-towards, basis)
        seen = 0.5 * math.atan2(out[2], out[1])
        axis = math.cos(seen) * basis + math.sin(seen) * across
        assert abs(abs(axis @ e) - 1) < 1e-6, (tilt, around, axis, e)
        assert out[0] == pytest.approx(0.5, abs=1e-6) and math.hypot(out[1], out[2]) == pytest.approx(0.5, abs=1e-6)
