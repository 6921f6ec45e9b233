"""Pictures of a browser: coarse at once, finer at rest, never of somewhere else."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from analytic import AnalyticField, ring_pose, sphere
from hypothesis import given
from hypothesis import strategies as st

from mmsynth.operations.views.displays import find_display, look, picture
from mmsynth.scene.scene import PosedCamera
from mmsynth.sensors.camera import Camera
from mmsynth.viewer.pictures import Looking, Wanted, sizes_of

FIELD = AnalyticField(sphere(), mirrored=0.2)
RGB, DEPTH = find_display(FIELD, "rgb"), find_display(FIELD, "depth")
VIEW, OTHER = (PosedCamera(Camera(160, 120, 150.0, 150.0, 79.5, 59.5), ring_pose(i, 8)) for i in (0, 3))


def looking(**wanted: object) -> Looking:
    found = Looking(replace(Wanted(RGB, DEPTH), **wanted))  # type: ignore[arg-type]
    found.rays_per_second = 6000.0  # of which the first picture may have 480
    found.move(VIEW)
    return found


def shown(one: Looking) -> np.ndarray:
    image = one.picture(FIELD, lambda display: 1.0, {}, None)
    assert image is not None
    return image


def finer(one: Looking) -> bool:
    one.rays_per_second = 6000.0
    return one.finer(FIELD, lambda: None)


def test_it_gets_finer_until_it_is_what_the_field_renders() -> None:
    one, widths = looking(), []
    assert one.coarse
    while not one.finished:
        assert finer(one)
        widths.append(shown(one).shape[1])
    assert widths[0] ** 2 * 0.75 <= 480 and widths == sorted(set(widths)) and widths[-1] == 160
    seen = look(FIELD, VIEW, [RGB])
    assert seen is not None
    np.testing.assert_array_equal(shown(one), picture(FIELD, RGB, seen))


def test_a_move_starts_over_and_drops_what_is_stale() -> None:
    one = looking()
    finer(one)
    assert one.finer(FIELD, lambda: None, lambda: one.move(OTHER) or True) is False  # type: ignore[func-returns-value]
    assert one.coarse and finer(one)
    coarse = shown(one)
    fresh = looking()
    fresh.move(OTHER)
    finer(fresh)
    np.testing.assert_array_equal(coarse, shown(fresh))


def test_the_first_picture_is_finished_whatever_happens() -> None:
    one = looking()
    assert one.finer(FIELD, lambda: None, lambda: False) is True


def test_only_what_was_not_rendered_is_rendered_again() -> None:
    one = looking()
    while not one.finished:
        finer(one)
    assert one.wish(replace(one.wanted, stops=2.0)) and one.finished  # the same light, shown otherwise
    brighter = shown(one)
    assert one.wish(replace(one.wanted, stops=0.0))
    assert brighter.mean() > shown(one).mean()
    assert not one.wish(replace(one.wanted, wipe=0.5)) and one.coarse  # depth comes with it, but is not said to
    assert one.picture(FIELD, lambda display: 1.0, {}, None) is None


def test_a_wipe_has_both_sides_at_their_places() -> None:
    both = looking(wipe=0.25, most=160)
    while not both.finished:
        finer(both)
    seen = look(FIELD, VIEW, [RGB, DEPTH])
    assert seen is not None
    image, left, right = shown(both), picture(FIELD, RGB, seen), picture(FIELD, DEPTH, seen)
    np.testing.assert_array_equal(image[:, :39], left[:, :39])
    np.testing.assert_array_equal(image[:, 41:], right[:, 41:])
    assert (image[:, 40] == 255).all()


def test_without_training_frames_coverage_is_black() -> None:
    one = looking(left=find_display(FIELD, "coverage"))
    finer(one)
    assert shown(one).max() == 0


@given(st.integers(1, 4000), st.integers(1, 4000), st.integers(1, 4000), st.floats(1.0, 1e7))
def test_sizes_grow_from_what_there_is_time_for_to_what_is_wanted(width: int, height: int, most: int, rays: float) -> None:
    sizes = sizes_of(width, height, most, rays)
    assert sizes == sorted(set(sizes)) and sizes[-1] == max(1, round(width * min(1.0, most / max(width, height))))
    if len(sizes) > 1:
        assert sizes[0] == 24 or sizes[0] ** 2 * height / width <= rays
        assert all(b <= 2 * a + 1 for a, b in pairwise(sizes))


@pytest.mark.parametrize("wipe", [0.0, 1.0])
def test_one_side_alone_is_rendered_alone(wipe: float) -> None:
    assert Wanted(RGB, DEPTH, wipe=wipe).displays == ((DEPTH,) if wipe == 0.0 else (RGB,))
