"""Trains a small network from RGB to multispectral on a generated dataset, and scores it on real test frames that it never saw.

    mmsynth fit example
    mmsynth generate-dataset --poses train.json --modalities rgb,ms --outputs geometry --out pairs
    python examples/train_rgb_to_ms.py pairs example [--steps 3000]

where train.json is, say, {"trajectory": "perturb", "per_pose": 8, "rotation_deg": 4, "translation": 0.08, "seed": 0}.

Every crop is seen as the camera would have recorded it: through the mosaic, with shot noise, and demosaicked again. Flips and crops
(`crop_and_flip`) are those that leave polarization right, should you train on it. The scene needs aligned truth (gt/aligned) to be scored.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from mmsynth import AlignedDataset, InputError, load_scene
from mmsynth.operations.dataset.aligned import crop_and_flip
from mmsynth.operations.evaluation.evaluate import psnr_from_mse, spectral_angle_deg
from mmsynth.packaged import data_folder
from mmsynth.scene.ground_truth import GroundTruth
from mmsynth.scene.images import load_frame
from mmsynth.sensors.mosaic import demosaic, mosaic

FULL_WELL = 10_000.0  # electrons at full scale, of the noise in training
CROP, BATCH = 48, 16


class Network(nn.Module):
    """Three convolutions beside a linear map: (B, 3, H, W) → (B, K, H, W)."""

    def __init__(self, channels: int, width: int = 32) -> None:
        super().__init__()
        self.linear = nn.Conv2d(3, channels, 1)
        self.deep = nn.Sequential(
            nn.Conv2d(3, width, 3, padding=1), nn.GELU(), nn.Conv2d(width, width, 3, padding=1), nn.GELU(), nn.Conv2d(width, channels, 1)
        )  # fmt: skip
        nn.init.zeros_(self.deep[-1].weight)
        nn.init.zeros_(self.deep[-1].bias)

    def forward(self, rgb: Tensor) -> Tensor:
        return self.linear(rgb) + self.deep(rgb)


def recorded(rgb: Tensor, pattern: np.ndarray, generator: torch.Generator) -> Tensor:
    """What the camera would have recorded of (B, 3, H, W), demosaicked."""
    raw = mosaic(rgb, pattern)
    noisy = raw + (raw.clamp(min=0.0) / FULL_WELL).sqrt() * torch.randn(raw.shape, generator=generator)
    return demosaic(noisy, pattern)


def batches(dataset: AlignedDataset, generator: torch.Generator) -> Iterator[dict[str, Tensor]]:
    """Crops without end; a view gives one whenever its turn comes."""
    whole = [item for item in dataset if bool(torch.isfinite(item["rgb"]).any())]  # type: ignore[attr-defined]
    crops = lambda items: torch.utils.data.default_collate(
        [crop_and_flip(i, (CROP, CROP), generator, dataset.polarizer_angles_deg) for i in items]
    )
    while True:
        yield from DataLoader(whole, BATCH, shuffle=True, drop_last=len(whole) >= BATCH, collate_fn=crops, generator=generator)  # type: ignore[arg-type]


def train(dataset: AlignedDataset, pattern: np.ndarray, steps: int, seed: int = 0) -> Network:
    """Adam on the mean absolute error, of pixels that have a ray; the learning rate falls to nothing along a cosine."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    network = Network(len(dataset.content["modalities"]["ms"]["channels"]))
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for step, batch in zip(range(steps), batches(dataset, generator), strict=False):
        seen = torch.isfinite(batch["rgb"]).all(1, keepdim=True) & torch.isfinite(batch["ms"]).all(1, keepdim=True)
        rgb = torch.where(seen, batch["rgb"], torch.zeros(()))
        error = (network(recorded(rgb, pattern, generator)) - batch["ms"]).abs()
        loss = torch.where(seen, error, torch.zeros(())).sum() / seen.sum().clamp(min=1) / error.shape[1]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 500 == 0:
            print(f"step {step}: mean absolute error {loss.item():.4f}")
    return network


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("scene", help="folder of the scene, or example")
    parser.add_argument("--steps", type=int, default=3000)
    arguments = parser.parse_args()
    scene = load_scene(data_folder("example_scene") if arguments.scene == "example" else Path(arguments.scene))
    truth, sensor = GroundTruth(scene), scene.sensors["rgb"]
    frames = [f for f in scene.frames_of("rgb", scene.split.test) if "ms" in truth.aligned(f.view)]
    if not frames or sensor.mosaic is None:
        raise InputError(f"{scene.root}: no test views with aligned truth (gt/aligned) and mosaicked RGB, expected some to score.")
    dataset = AlignedDataset(arguments.dataset, ["rgb", "ms"], geometry=False)
    began = time.perf_counter()
    network = train(dataset, sensor.mosaic, arguments.steps)
    seconds = time.perf_counter() - began
    square, angle = [], []
    with torch.no_grad():
        for frame in frames:
            raw = torch.from_numpy(load_frame(sensor, frame)[0])
            found = network(demosaic(raw, sensor.mosaic)[None])[0].movedim(0, -1).numpy()
            real = truth.aligned(frame.view)["ms"]
            square.append(np.clip(found, 0, 1) - np.clip(real, 0, 1))
            angle.append(spectral_angle_deg(found.reshape(-1, found.shape[-1]), real.reshape(-1, real.shape[-1])))
    mse = float(np.mean(np.square(square), dtype=np.float64))
    sam = float(np.nanmean(np.concatenate(angle), dtype=np.float64))
    print(f"{len(dataset)} generated views, {arguments.steps} steps in {seconds:.0f} s")
    print(f"{len(frames)} real test frames: PSNR {psnr_from_mse(mse):.2f} dB, spectral angle {sam:.2f} deg")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
