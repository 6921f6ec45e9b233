"""The parts of a picture in which a field errs for different reasons: highlights, silhouettes, and the rest."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

PARTS = ("highlights", "silhouettes", "rest")
_BRIGHTER = 0.08  # than the median around, of full scale
_AROUND = 9  # pixels
_STEP = 0.03  # of depth between neighbours, relative


def parts_of(light: np.ndarray, geometry: Mapping[str, np.ndarray], labels: Mapping[str, str], where: np.ndarray) -> dict[str, np.ndarray]:
    """Where highlights, silhouettes and neither are; the first two may overlap.

    A highlight is on an object and 0.08 brighter than the median of 9x9 pixels around it, in every channel (a pattern is so in some only),
    and the pixels beside these. A silhouette has another label, or a depth other by 3 %, within 3x3 pixels.

    Args:
        light: (H, W, C) true radiance, 1.0 = full scale (of a polarization S0 alone). geometry: ``depth_z`` (H, W), 0 where
            nothing is hit, and ``label`` (H, W) where it is known. labels: by number (as text), names; what is named table, board, room or
            background is no object. where: (H, W) bool, the pixels in question.
    """
    from scipy.ndimage import binary_dilation, maximum_filter, median_filter, minimum_filter  # half a second to import

    depth = geometry["depth_z"]
    label = geometry.get("label", np.zeros(depth.shape, np.uint8))
    least = light.min(-1)
    bright = least - median_filter(least, _AROUND) > _BRIGHTER
    known = [int(n) for n, name in labels.items() if not any(part in name for part in ("table", "board", "room", "background"))]
    highlights = binary_dilation(bright & np.isin(label, known) if known else bright) & where
    edge = (maximum_filter(label, 3) != minimum_filter(label, 3)) | (maximum_filter(depth, 3) - minimum_filter(depth, 3) > _STEP * depth)
    return {"highlights": highlights, "silhouettes": edge & where, "rest": where & ~edge & ~highlights}
