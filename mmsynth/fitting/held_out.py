"""Views that are not learned from while directions are on trial.

What a fit has learned of a view says little of the views between: appearance can hold a colour for each camera. So every eighth view is
held out from when radiance first depends on direction until it is decided how far it does. These views judge that, and lamps before.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from mmsynth.field import kernels
from mmsynth.fitting.importance import Importance
from mmsynth.fitting.measurements import Measurements

_EVERY, _FIRST = 8, 4  # of the views in order; fewer than so many are all learned from


def held_out_tiles(measurements: Measurements) -> Tensor | None:
    """(T,) bool, which tiles are of views that are held out, None: no view is. Modalities that have no other view, too, keep theirs."""
    views = np.concatenate([measurements[n].views for n in measurements.order])
    known = np.unique(views)
    if len(known) < _EVERY:
        return None
    held = torch.from_numpy(np.isin(views, known[_FIRST::_EVERY]))
    tiles, pixels = measurements.frames.first_tile.cpu(), measurements.chosen.pixels.cpu()
    out = held[torch.searchsorted(tiles, torch.arange(len(pixels)), right=True) - 1]
    for begin, end in pairwise(measurements.modalities.first_tile.tolist()):
        own, drawn = out[begin:end], pixels[begin:end]
        if not drawn[own].any() or not drawn[~own].any():
            out[begin:end] = False
    return out.to(measurements.chosen.pixels.device)


def selections(importance: Importance, held: Tensor | None) -> tuple[kernels.Selection, kernels.Selection]:
    """Of the pixels of the views that are learned from, and of those held out; of all pixels of a modality where none is held out.

    More of those whose residuals are large: of a small object before nothing, even draws see next to nothing.
    """
    if held is None:
        every = importance.renewed()
        return every, every
    not_judging = ~held
    for begin, end in pairwise(importance.first_tile.tolist()):
        not_judging[begin:end] &= held[begin:end].any()
    return importance.renewed(held), importance.renewed(not_judging)
