"""Fewer training frames of some modalities."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mmsynth.errors import InputError
from mmsynth.packaged import data_folder
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene, keep_frames, make_split

SCENE = load_scene(data_folder("example_scene"))


def _training(scene: Scene, name: str) -> list[int]:
    return [frame.view for frame in scene.frames_of(name, scene.split.train)]


@given(st.dictionaries(st.sampled_from(list(SCENE.sensors)), st.integers(1, 40)))
def test_keep_frames(limits: dict[str, int]) -> None:
    kept = keep_frames(SCENE, limits)
    assert kept.split == SCENE.split and kept.sensors is SCENE.sensors
    assert [f for f in SCENE.frames if f in kept.frames] == list(kept.frames)  # a subset, in order
    for name in SCENE.sensors:
        before, after = _training(SCENE, name), _training(kept, name)
        assert len(after) == min(limits.get(name, len(before)), len(before))
        assert kept.frames_of(name, SCENE.split.test) == SCENE.frames_of(name, SCENE.split.test)
        # evenly spread: no gap is longer than another by more than one view, the ends half a gap
        places = np.array([before.index(view) for view in after])
        if len(places) > 1:
            gaps = np.diff(places)
            assert gaps.max() - gaps.min() <= 1
            assert max(places[0], len(before) - 1 - places[-1]) <= gaps.max() / 2 + 1
    assert keep_frames(kept, limits).frames == kept.frames


def test_one_frame_is_the_middle_one() -> None:
    before = _training(SCENE, "pol")
    assert _training(keep_frames(SCENE, {"polarization": 1}), "pol") == [before[len(before) // 2]]


def test_bad_limits() -> None:
    with pytest.raises(InputError, match="no modality 'thermal', expected one of rgb"):
        keep_frames(SCENE, {"thermal": 3})
    with pytest.raises(InputError, match="pol: 0 training frames"):
        keep_frames(SCENE, {"pol": 0})


def test_views_that_all_end_with_nine_are_not_all_for_tests() -> None:
    split = make_split([9, 19, 29])
    assert split.train == (9, 19) and split.test == (29,) and split.source == "the last view"
