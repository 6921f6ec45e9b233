"""A colour for each camera is no view dependence: between the cameras it says nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_scenes import QUICK, around, write_scene

from mmsynth.fitting import trainer
from mmsynth.fitting.run import fit
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene


@pytest.fixture
def tinted(tmp_path: Path) -> Scene:
    """A matte ball; each picture has a tint of its own, as a white balance on automatic gives."""
    random = np.random.default_rng(0)
    tint = lambda image: image * (1.0 + 0.3 * random.uniform(-1.0, 1.0, 3))
    return load_scene(write_scene(tmp_path / "scene", {"rgb": around(24)}, alter={"rgb": tint}))


def _degree(scene: Scene, folder: Path) -> int:
    recipe = QUICK.with_changes({"radiance.exposure": "off", "radiance.light": "off", "poses.views": "off"})
    value = fit(scene, folder, recipe=recipe, steps=300, seed=0).view_dependence["rgb"]
    assert isinstance(value, int)
    return value


def test_what_differs_from_picture_to_picture_is_not_explained_by_directions(
    tinted: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, row: Callable[[str, str, str], None]
) -> None:
    ours = _degree(tinted, tmp_path / "ours")
    monkeypatch.setattr(trainer, "held_out_tiles", lambda measurements: None)
    usual = _degree(tinted, tmp_path / "usual")
    assert ours == 0 and usual >= 2
    row(
        "pictures of a matte ball with tints of up to 30 %, 24 views",
        f"judged by other rays of the same views: radiance of degree {usual} over directions",
        f"judged by views held out: degree {ours}",
    )
