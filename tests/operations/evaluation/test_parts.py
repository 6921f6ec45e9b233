"""Highlights, silhouettes and the rest of a picture whose parts are known."""

from __future__ import annotations

import numpy as np

from mmsynth.operations.evaluation.parts import parts_of

LABELS = {"0": "background(room)", "1": "table", "2": "ball"}


def _picture() -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """A table (left) and a ball (right), and a step of depth within the ball."""
    label = np.ones((40, 60), np.uint8)
    label[:, 30:] = 2
    depth = np.full((40, 60), 2.0, np.float32)
    depth[:, 45:] = 2.2
    return np.full((40, 60, 3), 0.3, np.float32), {"label": label, "depth_z": depth}, np.ones((40, 60), bool)


def test_highlights_are_bright_in_every_channel_and_on_objects() -> None:
    light, geometry, where = _picture()
    light[10, 38] += 0.2  # on the ball
    light[10, 10] += 0.2  # on the table
    light[30, 38, 0] += 0.2  # a pattern: red alone
    light[20, 38] += 0.05  # too faint
    found = parts_of(light, geometry, LABELS, where)["highlights"]
    assert {tuple(p) for p in np.argwhere(found)} == {(10, 38), (9, 38), (11, 38), (10, 37), (10, 39)}
    assert parts_of(light, geometry, {}, where)["highlights"][10, 10]  # nobody said what is an object


def test_silhouettes_are_steps_of_label_and_depth() -> None:
    light, geometry, where = _picture()
    found = parts_of(light, geometry, LABELS, where)
    assert set(np.flatnonzero(found["silhouettes"].all(0))) == set(np.flatnonzero(found["silhouettes"].any(0))) == {29, 30, 44, 45}
    assert np.array_equal(found["rest"], ~found["silhouettes"] & ~found["highlights"])


def test_a_plane_that_recedes_has_no_silhouette_and_nothing_outside_counts() -> None:
    light, geometry, where = _picture()
    geometry = {"depth_z": np.broadcast_to(np.linspace(2.0, 2.5, 60, dtype=np.float32), (40, 60))}
    where[:, :20] = False
    found = parts_of(light, geometry, LABELS, where)
    assert not found["silhouettes"].any() and np.array_equal(found["rest"], where)
