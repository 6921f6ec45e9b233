"""Fits that decide by few rays, for tests of something else: looks at how a fit does take longer than its steps where it has only some."""

from __future__ import annotations

import pytest

from mmsynth.fitting import candidates, lighting, measurements, needs, refinement, table_sizes, trainer, unseen


def few_looks(monkeypatch: pytest.MonkeyPatch, rays: int = 64) -> None:
    """So many rays at a time; by as many as usual it takes minutes of what a GPU does at once."""
    for module, name, number in (
        (candidates, "_STEPS", 2), (candidates, "_LOOKS", 1), (candidates, "_RAYS", rays),
        (lighting, "_RAYS", rays), (measurements, "_TYPICAL", 1024),
        (needs, "_LOOKED_AT", 256), (refinement, "AT_ONCE", rays), (refinement, "_DECIDE", 2), (refinement, "_PER_STEP", 2 * rays),
        (refinement, "_PER_VIEW", 1), (trainer, "_MOVE_EVERY", 1), (table_sizes, "_PROBES", 8 * rays),
        (unseen, "_RAYS", 64 * rays), (unseen, "_RAYS_AT_ONCE", 16 * rays),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, number)
