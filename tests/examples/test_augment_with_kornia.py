"""The example turns what is a direction in the picture with it: closed forms of flips, quarter turns and any rotation."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import kornia.augmentation as K
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from mmsynth.sensors.modules import Demosaic, IntensitiesFromStokes, Mosaic, StokesFromIntensities, turn_stokes
from mmsynth.sensors.polarization import (
    angle_of_linear_polarization,
    aolp_difference,
    degree_of_linear_polarization,
    flip_stokes,
    rotate_stokes,
)

SCRIPT = Path(__file__).parents[2] / "examples" / "augment_with_kornia.py"
EXAMPLE = runpy.run_path(str(SCRIPT))
augment, sample_of = EXAMPLE["augment"], EXAMPLE["sample_of"]


def polarization(stokes: Tensor) -> tuple[Tensor, Tensor]:
    flat = stokes.movedim(1, -1)
    return degree_of_linear_polarization(flat), angle_of_linear_polarization(flat)


def even(sample: dict[str, Tensor]) -> dict[str, Tensor]:
    """With one direction everywhere: AoLP 30 degrees, normals and flow to the upper right."""
    stokes = torch.tensor([1.0, 0.4 * np.cos(np.pi / 3), 0.4 * np.sin(np.pi / 3)])
    fill = lambda values: torch.as_tensor(values, dtype=torch.float32)[None, :, None, None].expand(2, -1, 64, 64).clone()
    return sample | {"pol/stokes": fill(stokes), "normal_camera": fill([0.6, -0.48, -0.64]), "flow": fill([3.0, -1.0])}


def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    EXAMPLE["main"]()
    assert capsys.readouterr().out.count("DoLP") == 2


@pytest.mark.parametrize(("operation", "sign"), [(K.RandomHorizontalFlip, (-1.0, 1.0)), (K.RandomVerticalFlip, (1.0, -1.0))])
def test_flips(operation: Any, sign: tuple[float, float]) -> None:
    sample = even(sample_of())
    out = augment(sample, K.AugmentationSequential(operation(p=1.0)))
    axis = -1 if sign[0] < 0 else -2
    assert torch.allclose(out["ms"], sample["ms"].flip(axis), atol=1e-5) and torch.equal(out["mask"], sample["mask"].flip(axis))
    assert torch.allclose(out["pol/stokes"], flip_stokes(sample["pol/stokes"].flip(axis).movedim(1, -1)).movedim(-1, 1), atol=1e-5)
    assert torch.allclose(polarization(out["pol/stokes"])[1], torch.tensor(-30.0), atol=1e-3)
    for key in ("normal_camera", "flow"):
        assert torch.allclose(out[key][:, :2], sample[key][:, :2] * torch.tensor(sign)[:, None, None], atol=1e-5)
    assert torch.allclose(out["normal_camera"][:, 2], sample["normal_camera"][:, 2])


@pytest.mark.parametrize("degrees", [90.0, 30.0, -70.0])
def test_rotations(degrees: float) -> None:
    sample = even(sample_of())
    rotation = K.AugmentationSequential(K.RandomRotation((degrees, degrees), p=1.0))
    out = augment(sample, rotation)
    # kornia turns the picture counter-clockwise: from right towards up, as AoLP is counted
    middle = (slice(None), slice(24, 40), slice(24, 40))
    dolp, aolp = (x[middle] for x in polarization(out["pol/stokes"]))
    assert torch.allclose(dolp, torch.tensor(0.4), atol=1e-4)
    assert aolp_difference(aolp, torch.tensor(30.0 + degrees)).abs().max() < 1e-2
    turned = rotate_stokes(sample["pol/stokes"].movedim(1, -1), torch.tensor(-np.radians(degrees))).movedim(-1, 1)
    assert torch.allclose(out["pol/stokes"][:, :, *middle[1:]], turned[:, :, *middle[1:]].float(), atol=1e-4)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    for key, (x, y) in {"normal_camera": (0.6, -0.48), "flow": (3.0, -1.0)}.items():
        expected = torch.tensor([c * x + s * y, -s * x + c * y])
        assert torch.allclose(out[key][:, :2, *middle[1:]].float(), expected[:, None, None].float(), atol=1e-4)


def test_the_map_of_dolp_is_the_warped_map_and_aolp_goes_around_as_before() -> None:
    sample = sample_of()
    augmentation = K.AugmentationSequential(K.RandomHorizontalFlip(p=1.0), K.RandomRotation((35.0, 35.0), p=1.0))
    out = augment(sample, augmentation)
    before, _ = polarization(sample["pol/stokes"])
    warped = augmentation(before[:, None], params=augmentation._params, data_keys=["image"])[:, 0]
    dolp, aolp = polarization(out["pol/stokes"])
    v, u = torch.meshgrid(*[torch.linspace(-1, 1, 64)] * 2, indexing="ij")
    ring = (u**2 + v**2 > 0.1) & (u**2 + v**2 < 0.6)
    assert (dolp - warped)[:, ring].abs().max() < 5e-3
    # light along the ball's outline is so after any flip and turn
    assert aolp_difference(aolp, torch.rad2deg(torch.atan2(-v, u))).abs()[:, ring].max() < 1.0
    # and the camera's normals still point outwards
    assert torch.allclose(out["normal_camera"][:, 0][:, ring], u[ring], atol=0.05)


def test_shear_is_refused() -> None:
    with pytest.raises(ValueError, match="not sheared"):
        augment(sample_of(), K.AugmentationSequential(K.RandomShear((20.0, 20.0), p=1.0)))


def test_modules_compose_and_are_differentiable() -> None:
    pattern = np.array([[0, 1], [1, 2]])
    image = torch.rand(2, 3, 16, 18, dtype=torch.float64, requires_grad=True)
    pipeline = nn.Sequential(IntensitiesFromStokes(), StokesFromIntensities())
    assert torch.allclose(pipeline(image), image)
    raw = Mosaic(pattern)(image)
    assert raw.shape == (2, 1, 16, 18)
    assert torch.allclose(Mosaic(pattern)(Demosaic(pattern)(raw)), raw)
    in_kornia = K.AugmentationSequential(K.ImageSequential(StokesFromIntensities()), K.RandomHorizontalFlip(p=1.0), data_keys=["image"])
    found = in_kornia(torch.rand(2, 4, 16, 18))
    assert found.shape == (2, 3, 16, 18)
    pipeline(image).sum().backward()
    assert image.grad is not None
    assert torch.equal(turn_stokes(image, torch.eye(3)[None].expand(2, -1, -1)), image)
