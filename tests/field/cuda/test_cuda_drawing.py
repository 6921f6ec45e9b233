"""Drawing in Triton: the same pixels and random numbers as the definition, to the bit."""

import numpy as np
import pytest
import test_drawing
import torch

from mmsynth.field import kernels
from mmsynth.field.kernels import cuda, reference


@pytest.mark.parametrize(
    ("seed", "key", "rays", "share"),
    [(0, (1, 2), (50, 40, 30), None), (1, (2**32 - 1, 2**31 + 5), (0, 33, 20), 0.5), (3, (123456789, 0xDEADBEEF), (20, 10, 0), 0.01)],
)
def test_it_draws_what_its_definition_says(
    device: str, seed: int, key: tuple[int, int], rays: tuple[int, int, int], share: float | None
) -> None:
    tables, (selection, _) = test_drawing._scene(), test_drawing._selection(seed, share)
    residual = torch.from_numpy(np.random.default_rng(seed).random(len(selection.pixels), np.float32))
    ends, weight = reference.odds(residual, selection.pixels, tables[2].first_tile, 0.5)
    selection = selection._replace(ends=ends, weight=weight)
    here = lambda parts: type(parts)(*(x.to(device) for x in parts))
    ours = cuda.draw(*map(here, tables), here(selection), list(rays), key)
    theirs = reference.draw(*tables, selection, list(rays), key)
    for name in ("origins", "directions", "jitter", "alpha", "ray_weight", "tile", "frame"):
        test_drawing._same(getattr(ours, name).cpu(), getattr(theirs, name))
    for name in kernels.Measured._fields:
        test_drawing._same(getattr(ours.measured, name).cpu(), getattr(theirs.measured, name))


def test_no_rays(device: str) -> None:
    tables, (selection, _) = test_drawing._scene(), test_drawing._selection(0, None)
    here = lambda parts: type(parts)(*(x.to(device) for x in parts))
    drawn = cuda.draw(*map(here, tables), here(selection), [0, 0, 0], (1, 2))
    assert len(drawn.origins) == len(drawn.frame) == 0
