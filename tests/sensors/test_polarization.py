import numpy as np
import pytest
import torch

from mmsynth.sensors.polarization import (
    analyser_axes,
    angle_of_linear_polarization,
    aolp_error,
    coherency_from_factor,
    degree_of_linear_polarization,
    intensities_to_stokes,
    reference_axes,
    stokes_to_intensities,
)

ANGLES = (0.0, 45.0, 90.0, 135.0)


def test_axes_on_the_optical_axis_are_right_and_up() -> None:
    forward, right = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    x, y = reference_axes(forward, right)
    torch.testing.assert_close(x, right)
    torch.testing.assert_close(y, torch.tensor([[0.0, -1.0, 0.0]]))  # OpenCV: y is down, so up is -y


def test_malus() -> None:
    """Fully polarized light at 30 degrees behind analysers of a camera rolled by any angle."""
    for roll in np.radians([0.0, 40.0, 100.0, 135.0, 180.0, 270.0]):
        right = torch.tensor([[np.cos(roll), -np.sin(roll), 0.0]], dtype=torch.float32)
        forward = torch.tensor([[0.0, 0.0, 1.0]])
        axes = analyser_axes(forward, right, torch.deg2rad(torch.tensor([ANGLES])))
        field_axis = torch.tensor([np.cos(np.radians(30)), -np.sin(np.radians(30)), 0.0], dtype=torch.float32)
        intensities = (axes @ field_axis).square()[0].numpy()
        stokes = intensities_to_stokes(intensities, ANGLES)
        expected = (30.0 - np.degrees(roll) + 90.0) % 180.0 - 90.0  # rolling the camera counter-clockwise turns AoLP back
        assert aolp_error(angle_of_linear_polarization(stokes), np.array(expected)) < 1e-4
        assert degree_of_linear_polarization(stokes) == pytest.approx(1.0, abs=1e-6)


def test_stokes_round_trip_equals_polanalyser() -> None:
    oracle = pytest.importorskip("polanalyser")
    stokes = np.random.default_rng(0).normal(size=(5, 6, 3)) * 0.2 + np.array([1.0, 0.0, 0.0])
    intensities = stokes_to_intensities(stokes, ANGLES)
    np.testing.assert_allclose(intensities_to_stokes(intensities, ANGLES), stokes, atol=1e-12)
    images = [intensities[..., i] for i in range(4)]
    theirs = oracle.calcStokes(images, [oracle.polarizer(np.radians(a))[:3, :3] for a in ANGLES])
    np.testing.assert_allclose(theirs[..., :3], stokes, atol=1e-6)
    np.testing.assert_allclose(degree_of_linear_polarization(stokes), oracle.cvtStokesToDoLP(stokes), atol=1e-9)
    assert aolp_error(angle_of_linear_polarization(stokes), np.degrees(oracle.cvtStokesToAoLP(stokes))).max() < 1e-6


def test_coherency_is_physical_for_any_factor_and_frame() -> None:
    torch.manual_seed(0)
    factor = coherency_from_factor(torch.randn(200, 6) * 3)
    directions = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    axes = analyser_axes(
        directions, torch.nn.functional.normalize(torch.randn(200, 3), dim=1), torch.deg2rad(torch.tensor([ANGLES]).expand(200, 4))
    )
    intensities = (axes @ factor).square().sum(-1).double().numpy()
    assert intensities.min() >= 0
    assert degree_of_linear_polarization(intensities_to_stokes(intensities, ANGLES)).max() <= 1 + 1e-6


def test_no_light_has_no_polarization() -> None:
    assert degree_of_linear_polarization(np.zeros((2, 3))).tolist() == [0.0, 0.0]
