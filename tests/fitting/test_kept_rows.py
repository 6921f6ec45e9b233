"""Rows of frames that have far more pixels than a fit draws: the same pixels, along the same rays, of all channels and in all places."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import ring
from hypothesis import given
from hypothesis import strategies as st

from mmsynth.fitting.kept_rows import kept_of, kept_rows, seen_in
from mmsynth.fitting.measurements import Measurements, draw, fingerprint, measure
from mmsynth.fitting.recipe import load_recipe
from mmsynth.fitting.trainer import Trainer
from mmsynth.scene.scene import Frame, MaskMeaning, Region, Scene, Sensor, Split
from mmsynth.sensors.camera import Camera, ray_map
from mmsynth.sensors.mosaic import channel_map

REGION = Region((0.0, 0.0, 0.0), 1.0)
CAMERA = Camera(24, 420, 250.0, 260.0, 11.5, 208.0, (-0.08, 0.02, 0.001, -0.002))
BAYER = Sensor("rgb", ("R", "G", "B"), (None,) * 3, mosaic=np.array([[0, 1], [1, 2]]))
FISHEYE = Camera(24, 420, 120.0, 118.0, 11.0, 212.0, (0.02, -0.01, 0.003, 0.0), "kannala_brandt")


@pytest.fixture(autouse=True)
def _all_frames_are_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mmsynth.fitting.kept_rows._HELD", 0)


@given(st.lists(st.integers(1, 4000), min_size=1, max_size=20), st.integers(1, 3000), st.floats(1.0, 1e12), st.integers(1, 5))
def test_rows_are_closer_together_than_rays(heights: list[int], width: int, rays: float, period: int) -> None:
    kept = kept_rows([Camera(width, h, 100.0, 100.0, 0.0, 0.0) for h in heights], rays, period)
    steps = {rows.step for rows in kept}
    (step,) = steps
    assert step % period == 1 % period  # what follows in a mosaic follows among kept rows
    assert step == 1 or step <= math.sqrt(sum(heights) * width / rays) / 2
    for height, rows in zip(heights, kept, strict=True):
        assert rows.start % period == 0 and rows.start < period * step
        assert step == 1 or len(range(height)[rows]) >= 60


def test_frames_take_turns_until_every_row_is_kept() -> None:
    kept = kept_rows([CAMERA] * 12, 12 * 420 * 24 / 40.0, 2)
    assert {rows.step for rows in kept} == {3}
    assert {row % 3 for rows in kept for row in range(420)[rows]} == {0, 1, 2}


def test_a_fit_that_draws_as_many_rays_keeps_all_rows() -> None:
    assert kept_rows([CAMERA] * 4, 4 * 420 * 24, 1) == [slice(0, None, 1)] * 4 == kept_rows([CAMERA] * 4, math.inf, 1)
    assert seen_in(CAMERA, slice(0, None, 1)) is CAMERA


def test_frames_that_are_not_large_are_kept_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [(BAYER, [Frame("rgb", i, Path("none"), CAMERA, np.eye(4)) for i in range(4)])]
    monkeypatch.setattr("mmsynth.fitting.kept_rows._HELD", 4 * 420 * 24 - 1)
    assert kept_of(frames, 100.0)[0][1].rows == slice(2, None, 3)
    monkeypatch.setattr("mmsynth.fitting.kept_rows._HELD", 4 * 420 * 24)
    assert [k.rows for k in kept_of(frames, 100.0)[0]] == [slice(0, None, 1)] * 4 and kept_of(frames, 100.0)[0][1].camera is CAMERA


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE, dataclasses.replace(CAMERA, distortion=())])
@pytest.mark.parametrize("rows", [slice(0, None, 3), slice(4, None, 3), slice(6, None, 7)])
def test_the_camera_of_some_rows_has_their_rays(camera: Camera, rows: slice) -> None:
    ours, exact = ray_map(seen_in(camera, rows)), ray_map(camera)
    np.testing.assert_allclose(ours[0], exact[0][rows], atol=1e-12)
    assert np.array_equal(ours[1], exact[1][rows])


def _frames(folder: Path, count: int, mask: bool = False) -> tuple[Frame, ...]:
    """Every pixel of a frame has a code of its own: 10,080 of them, times four, and below that which frame it is."""
    listed = []
    for i, pose in enumerate(ring(count)):
        path, masked = folder / f"{i}.npy", folder / f"mask_{i}.png"
        np.save(path, (4 * np.arange(420 * 24).reshape(420, 24) + i).astype(np.uint16))
        inside = np.zeros((420, 24), np.uint8)
        inside[50 + i : 300, 3:20] = 255
        cv2.imwrite(str(masked), inside)
        listed.append(Frame("rgb", i, path, CAMERA, pose, mask=masked if mask else None))
    return tuple(listed)


def _measured(folder: Path, rays: float, masks: MaskMeaning = "off") -> Measurements:
    frames = _frames(folder, 4, masks != "off")
    return measure({"rgb": (BAYER, frames)}, REGION, masks, rays_to_come=rays)


def test_what_is_drawn_of_some_rows_is_what_they_hold(tmp_path: Path) -> None:
    """Codes say which pixel it was: its channel, its ray, and that all pixels of kept rows come, and no others."""
    rays = 1000.0
    measurements, rows = _measured(tmp_path, rays), kept_rows([CAMERA] * 4, rays, 2)
    assert rows[1] == slice(2, None, 3) and measurements["rgb"].every == 3
    assert len(measurements.frames.codes8) == 2 * 24 * sum(len(range(420)[r]) for r in rows)
    batch = draw(measurements, {"rgb": slice(0, 3)}, {"rgb": 400_000}, np.random.default_rng(0))
    codes = torch.round(batch.measured.target * 65535).long().numpy()
    frame, row, column = codes % 4, codes // 4 // 24, codes // 4 % 24
    assert np.array_equal(batch.frame.numpy(), frame)
    found = set(zip(frame.tolist(), row.tolist(), column.tolist(), strict=True))
    assert found == {(i, r, c) for i in range(4) for r in range(420)[rows[i]] for c in range(24)}
    assert np.array_equal(batch.measured.output.numpy(), channel_map(BAYER.mosaic, 420, 24)[row, column])
    world = np.stack(ring(4))[frame][:, :3, :3] @ ray_map(CAMERA)[0][row, column][..., None]
    np.testing.assert_allclose(batch.directions.numpy(), world[..., 0], atol=5e-7)


def test_masks_are_of_the_same_rows(tmp_path: Path) -> None:
    measurements = _measured(tmp_path, 1000.0, "object")
    assert measurements["rgb"].every == 3 and measurements.empty is not None
    for selection, expected in ((None, True), (measurements.empty, False)):
        batch = draw(measurements, None, {"rgb": 20_000}, np.random.default_rng(0), selection)
        codes = torch.round(batch.measured.target * 65535).long().numpy()
        frame, row, column = codes % 4, codes // 4 // 24, codes // 4 % 24
        assert np.array_equal((row >= 50 + frame) & (row < 300) & (column >= 3) & (column < 20), np.full(len(codes), expected))


def test_what_is_known_of_frames_is_of_all_their_rows(tmp_path: Path) -> None:
    """How many pixels there are, their cameras, and what a checkpoint is recognised by."""
    some, whole = _measured(tmp_path, 1000.0), _measured(tmp_path, math.inf)
    assert some["rgb"].pixels == some["rgb"].total == whole["rgb"].pixels == 4 * 420 * 24
    assert some["rgb"].cameras == [CAMERA] and some["rgb"].camera_index.tolist() == [0] * 4
    assert fingerprint(some) == fingerprint(whole)
    changed = np.load(tmp_path / "2.npy")
    changed[0, 3] += 1  # of a row that is not kept
    np.save(tmp_path / "2.npy", changed)
    frames = tuple(Frame("rgb", i, tmp_path / f"{i}.npy", CAMERA, pose) for i, pose in enumerate(ring(4)))
    assert fingerprint(measure({"rgb": (BAYER, frames)}, REGION, rays_to_come=1000.0)) != fingerprint(whole)


def test_a_fit_says_which_rows_it_kept_and_learns_from_them(tmp_path: Path) -> None:
    frames = _frames(tmp_path, 4)
    scene = Scene(tmp_path, "test", {"rgb": BAYER}, frames, REGION, Split((0, 1, 2, 3), (), "none"), "m")
    said = {budget: Trainer(scene, load_recipe(None), None, budget, 0, "cpu") for budget in (0.01, 10.0)}
    assert "(rows kept: one in 3 of rgb)" in said[0.01].needs.choices["resolution"].why
    assert "rows kept" not in said[10.0].needs.choices["resolution"].why
    for trainer in said.values():
        trainer.run_step()
        assert math.isfinite(trainer.report().loss)
