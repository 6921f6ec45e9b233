"""The example of a network learns what there is to learn from a generated dataset."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mmsynth.errors import InputError
from mmsynth.sensors.mosaic import demosaic, mosaic

SCRIPT = Path(__file__).parents[2] / "examples" / "train_rgb_to_ms.py"
PATTERN = np.array([[0, 1], [1, 2]])
MIX = torch.tensor([[0.6, 0.3, 0.1], [0.0, 0.8, 0.2]])


@pytest.fixture(scope="module")
def script() -> Any:
    spec = importlib.util.spec_from_file_location("train_rgb_to_ms", SCRIPT)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["train_rgb_to_ms"] = module
    spec.loader.exec_module(module)
    return module


class Pairs(torch.utils.data.Dataset[Any]):
    """Smooth colours; two bands that are mixtures of them; a border where the lens has no ray."""

    content: Any = {"modalities": {"ms": {"channels": ["a", "b"]}}}  # noqa: RUF012
    polarizer_angles_deg: Any = {}  # noqa: RUF012

    def __len__(self) -> int:
        return 6

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        if index >= len(self):
            raise IndexError
        rgb = colours(index)
        ms = torch.einsum("kc,chw->khw", MIX, rgb)
        rgb[:, :2], ms[:, :2] = torch.nan, torch.nan
        return {"rgb": rgb, "ms": ms, "intrinsics": torch.eye(3)}


def colours(seed: int) -> torch.Tensor:
    coarse = torch.rand(1, 3, 5, 6, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(coarse, (56, 64), mode="bicubic", align_corners=True)[0].clamp(0, 1)


def test_it_learns_bands_that_are_mixtures(script: Any) -> None:
    network = script.train(Pairs(), PATTERN, 250)
    rgb = colours(99)
    with torch.no_grad():
        found = network(demosaic(mosaic(rgb, PATTERN), PATTERN)[None])[0]
    error = (found - torch.einsum("kc,chw->khw", MIX, rgb))[:, 3:-3, 3:-3].square().mean().sqrt()
    plain = torch.einsum("kc,chw->khw", MIX, rgb).std()
    assert error < 0.15 * plain


def test_noise_is_that_of_the_full_well(script: Any) -> None:
    grey = torch.full((1, 3, 200, 200), 0.36)
    seen = script.recorded(grey, np.array([[0]]), torch.Generator().manual_seed(0))
    assert float(seen[:, 0].std()) == pytest.approx((0.36 / script.FULL_WELL) ** 0.5, rel=0.03)


def test_it_says_what_it_needs(script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["train_rgb_to_ms.py", str(tmp_path), str(tmp_path)])
    with pytest.raises(InputError):
        script.main()
