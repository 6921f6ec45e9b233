"""kornia's augmentations of aligned samples of several sensors, with angles kept right.

kornia moves pixels. What of a pixel's values is a direction in the picture must turn with it: Stokes vectors, the normals of the camera's
axes, optical flow. Depth, masks and radiance stay what they are.

    python examples/augment_with_kornia.py
"""

from __future__ import annotations

import kornia.augmentation as K
import torch
from kornia.constants import DataKey
from torch import Tensor, nn

from mmsynth.sensors.modules import IntensitiesFromStokes, StokesFromIntensities, turn_stokes
from mmsynth.sensors.polarization import angle_of_linear_polarization, degree_of_linear_polarization

NEAREST = {"normal_camera", "flow", "depth_z", "mask"}  # not interpolated across edges
VECTORS = {"normal_camera", "flow"}  # first two components: right and down


def augment(sample: dict[str, Tensor], augmentation: K.AugmentationSequential) -> dict[str, Tensor]:
    """Turn, mirror, shift or scale a batch of aligned pictures (B, C, H, W) alike, whatever their sensors.

    Args:
        sample: as ``AlignedDataset`` has it: modalities by name, ``NAME/stokes``, and any of ``NEAREST``. World normals and poses have no
            place in a mirrored picture: leave them out. Raw intensities behind analysers become Stokes vectors first.
    """
    keys = sorted(sample, key=NEAREST.__contains__)  # the first one must be an image
    kinds = [DataKey.MASK if key in NEAREST else DataKey.IMAGE for key in keys]
    moved = augmentation(*(sample[key].float() for key in keys), data_keys=kinds)
    transform = augmentation.transform_matrix
    out = dict(zip(keys, moved, strict=True))
    for key in out:
        if key.endswith("stokes"):
            out[key] = turn_stokes(out[key], transform)
        elif key in VECTORS:
            linear = transform[:, :2, :2]
            if key == "normal_camera":  # of unit length, also where the picture is scaled
                linear = linear / linear.det().abs().sqrt()[:, None, None]
            turned = torch.einsum("bij,bjhw->bihw", linear.to(out[key]), out[key][:, :2])
            out[key] = torch.cat([turned, out[key][:, 2:]], 1)
    return out


def sample_of(size: int = 64) -> dict[str, Tensor]:
    """Two pictures of a ball whose light is polarized along its outline's normal: AoLP goes once around."""
    v, u = torch.meshgrid(*[torch.linspace(-1, 1, size)] * 2, indexing="ij")
    inside = (u**2 + v**2 < 0.8).float()
    angle = torch.atan2(-v, u)
    degree = 0.6 * (u**2 + v**2) * inside
    s0 = 0.2 + 0.5 * inside
    stokes = torch.stack([s0, s0 * degree * torch.cos(2 * angle), s0 * degree * torch.sin(2 * angle)])
    normal = torch.stack([u, v, -torch.sqrt((1 - u**2 - v**2).clamp(min=0))])
    normal = normal / normal.norm(dim=0).clamp(min=1e-6)
    ms = torch.stack([s0 * (0.2 + 0.1 * i) * (1 + 0.2 * u) for i in range(9)])
    sample = {"ms": ms, "pol/stokes": stokes, "normal_camera": normal, "depth_z": (2 - inside)[None], "mask": inside[None]}
    return {key: torch.stack([value, value]) for key, value in sample.items()}


def main() -> None:
    torch.manual_seed(0)
    sample = sample_of()
    augmentation = K.AugmentationSequential(K.RandomHorizontalFlip(), K.RandomVerticalFlip(), K.RandomRotation(45.0, p=1.0))
    out = augment(sample, augmentation)
    # modules of sensors stand in kornia's pipelines and in nn.Sequential
    camera = nn.Sequential(IntensitiesFromStokes(), K.RandomGaussianNoise(std=0.002, p=1.0), StokesFromIntensities())
    seen = camera(out["pol/stokes"]).movedim(1, -1)
    for i, light in enumerate(seen):
        degree, angle = degree_of_linear_polarization(light), angle_of_linear_polarization(light)
        row, column = 32, 52
        print(f"picture {i}: DoLP {degree[row, column]:.2f}, AoLP {angle[row, column]:.0f} deg to the right of the ball's middle")


if __name__ == "__main__":
    main()
