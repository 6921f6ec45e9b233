"""Masks in a fit: which pixels are drawn, what is learned outside, and what is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import ring

from mmsynth.errors import InputError
from mmsynth.field import kernels
from mmsynth.fitting.measurements import draw, empty_drawing_of, load_measurements, measure
from mmsynth.fitting.needs import Needs, assess
from mmsynth.fitting.recipe import Recipe
from mmsynth.fitting.run import fit
from mmsynth.fitting.trainer import Trainer
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.scene import Frame, MaskMeaning, Region, Scene, Sensor, Split
from mmsynth.sensors.camera import Camera, project

SENSORS = {
    "rgb": Sensor("rgb", ("R", "G", "B"), (None,) * 3, np.array([[1, 2], [0, 1]])),
    "mono": Sensor("mono", ("mono",), (None,)),
}
CAMERA = Camera(24, 18, 25.0, 25.0, 11.5, 8.5)
DISC = np.hypot(*(np.mgrid[:18, :24] - np.array([8.5, 11.5])[:, None, None])) < 5
SMALL = Recipe().with_changes({
    "sampling.samples_per_step": 2048, "sampling.samples_growth": 1.0,
    "sampling.initial_rays": 128, "surface.levels": 4, "surface.max_rows_log2": 12,
    "radiance.levels": 4, "radiance.max_rows_log2": 12, "surface.cells_per_pixel": 0.5, "radiance.cells_per_pixel": 1.0,
    "sampling.occupancy_resolution": 24, "sampling.occupancy_every": 16, "surface.initial_radius": 0.3,
    "schedule.sharpness_start": 20.0, "surface.measurements_per_cell": 1e-3, "radiance.view_dependence": 0, "radiance.exposure": "off",
})  # fmt: skip


def _scene(folder: Path, masks: MaskMeaning, outside: float = 1.0, without: tuple[tuple[str, int], ...] = ()) -> Scene:
    """A disc of 0.4 before a background of another brightness, raw, seen by a mosaic and a mono camera; masks but of some frames."""
    mask, frames = folder / "mask.png", []
    folder.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(mask), DISC.astype(np.uint8))
    for name in SENSORS:
        for view, pose in enumerate(ring(6)):
            path = folder / name / f"{view}.png"
            write_png16(path, np.where(DISC, 0.4, outside))
            frames.append(Frame(name, view, path, CAMERA, pose, name, None if (name, view) in without else mask))
    split = Split(tuple(range(5)), (5,), "test")
    return Scene(folder, "nerfstudio", SENSORS, tuple(frames), Region((0.0, 0.0, 0.0), 1.0), split, masks=masks)


def _needs(scene: Scene) -> Needs:
    return assess(scene, load_measurements(scene), Recipe(), 0, 1e6)


def _trained(scene: Scene, steps: int) -> Trainer:
    trainer = Trainer(scene, SMALL, steps, None, 0, "cpu")
    while trainer.progress < 1.0:
        trainer.run_step()
    return trainer


# --- what is drawn


@pytest.mark.parametrize("masks", ["ignore", "object"])
def test_no_colour_outside_a_mask_is_ever_drawn(masks: MaskMeaning, tmp_path: Path) -> None:
    measurements = load_measurements(_scene(tmp_path, masks))
    assert all(m.pixels == 5 * DISC.sum() and m.masked == 5 for m in measurements.values())
    batch = draw(measurements, {"rgb": slice(0, 3), "mono": slice(3, 4)}, {"rgb": 900, "mono": 900}, np.random.default_rng(0))
    torch.testing.assert_close(batch.measured.target, torch.full((1800,), 0.4), atol=1e-4, rtol=0)
    assert batch.alpha.isnan().all() if masks == "ignore" else (batch.alpha == 1.0).all()
    assert all(m.radiance_scale == pytest.approx(0.4, abs=1e-4) for m in measurements.values())
    batch = draw(measurements, None, {"mono": 20_000}, np.random.default_rng(1))
    turn = measurements.frames.rotation[batch.frame]
    in_camera = torch.einsum("nji,nj->ni", turn, batch.directions).double().numpy()
    column, row = np.rint(project(in_camera, CAMERA)).astype(int).T
    first = int(measurements.modalities.first_frame[measurements.order.index("mono")])
    every = set(zip((batch.frame - first).tolist(), row.tolist(), column.tolist(), strict=True))
    assert every == {(frame, row, column) for frame in range(5) for row, column in zip(*np.nonzero(DISC), strict=True)}


def test_empty_rays_go_through_pixels_outside(tmp_path: Path) -> None:
    measurements = load_measurements(_scene(tmp_path, "object"))
    batch = kernels.draw(*empty_drawing_of(measurements, {"rgb": 300, "mono": 500}, np.random.default_rng(0)))
    assert batch.origins.shape == batch.directions.shape == (800, 3)
    # the disc is that of a ball around the origin: rays outside pass it
    inside = draw(measurements, None, {"mono": 500}, np.random.default_rng(0))
    closest, within = (
        torch.linalg.vector_norm(b.origins - b.directions * (b.origins * b.directions).sum(1, keepdim=True), dim=1) for b in (batch, inside)
    )
    assert closest.min() > within.max() - 0.03
    assert all(m.empty == 5 * (~DISC).sum() for m in measurements.values())
    ignored = load_measurements(_scene(tmp_path, "ignore"))
    assert ignored.empty is None and not any(m.empty for m in ignored.values())


@pytest.mark.parametrize(("masks", "pixels"), [("ignore", 4 * DISC.sum() + DISC.size), ("object", 4 * DISC.sum())])
def test_a_frame_without_a_mask_is_all_learned_from_or_not_at_all(masks: MaskMeaning, pixels: int, tmp_path: Path) -> None:
    scene = _scene(tmp_path, masks, without=(("rgb", 2),))
    m = load_measurements(scene)["rgb"]
    assert m.pixels == pixels and m.masked == 4
    assert ("1 frames of rgb have no mask and are not learned from" in _needs(scene).choices["masks"].why) == (masks == "object")


def test_masks_that_are_off_change_no_bit(tmp_path: Path) -> None:
    scene = _scene(tmp_path, "off")
    plain = replace(scene, frames=tuple(replace(frame, mask=None) for frame in scene.frames))
    one, other = (_trained(s, 8).field.state_dict() for s in (scene, plain))
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert _needs(scene).choices["masks"].why == "off: 10 of 10 training frames have one, they only score"
    assert _needs(plain).choices["masks"].why == "off: 0 of 10 training frames have one"


def test_empty_masks_are_refused(tmp_path: Path) -> None:
    scene = _scene(tmp_path, "object")
    assert cv2.imwrite(str(tmp_path / "mask.png"), np.zeros((18, 24), np.uint8))
    with pytest.raises(InputError, match=r"mask.png: this mask of rgb and those of all its other training frames are empty") as refused:
        load_measurements(scene)
    assert "\n" not in str(refused.value)


def test_checkpoints_know_their_masks(tmp_path: Path) -> None:
    scene = _scene(tmp_path, "object")
    saved = Trainer(scene, SMALL, 5, None, 0, "cpu").checkpoint()
    Trainer(scene, SMALL, 5, None, 0, "cpu").restore(saved)
    with pytest.raises(InputError, match="checkpoint: was made with scene"):
        Trainer(replace(scene, masks="ignore"), SMALL, 5, None, 0, "cpu").restore(saved)


# --- what is chosen, and learned


def test_choices_follow_what_masks_mean(tmp_path: Path) -> None:
    needs = {masks: _needs(_scene(tmp_path, masks)) for masks in ("object", "ignore", "off")}
    assert {masks: needs[masks].choices["masks"].value for masks in needs} == {masks: masks for masks in needs}
    assert (
        needs["object"]
        .choices["masks"]
        .why.startswith(f"object: nothing is outside; inside are rgb {DISC.mean():.1%}, mono {DISC.mean():.1%}")
    )
    assert not needs["object"].design.background and not needs["object"].design.far_light
    assert needs["off"].design.background and not needs["object"].sparse


def test_a_sensor_without_masks_of_the_object_learns_colours_alone(tmp_path: Path) -> None:
    scene = _scene(tmp_path, "object", without=tuple(("mono", view) for view in range(6)))
    needs = _needs(scene)
    assert needs.sparse == ("mono",) and needs.share == {"rgb": 1.0, "mono": 1.0}
    assert "mono without masks: learned from the geometry of the others" in needs.choices["masks"].why


@pytest.mark.usefixtures("decided_by_few_rays")
def test_an_object_is_found_by_its_outlines(tmp_path: Path) -> None:
    """The ball whose outline the masks are; nothing else tells it from its background, which has its colour."""
    scene = _scene(tmp_path, "object", outside=0.4)
    field = fit(scene, tmp_path / "run", recipe=SMALL, steps=200)
    frame = scene.frames_of("mono", (5,))[0]
    seen = field.render(frame.camera, frame.camera_to_world, ["mono", "rgb"])
    r = np.hypot(*(np.mgrid[:18, :24] - np.array([8.5, 11.5])[:, None, None]))
    assert (seen.opacity[r < 4] > 0.9).all() and (seen.opacity[r > 7] < 0.1).all()
    for channels in seen.channels.values():
        np.testing.assert_allclose(np.median(channels[r < 4], 0), 0.4, atol=0.05)
    assert field.manifest["scene"]["masks"] == "object"


@pytest.mark.usefixtures("decided_by_few_rays")
def test_fields_of_an_object_do_not_depend_on_colours_outside(tmp_path: Path) -> None:
    one, other = (_trained(_scene(tmp_path / str(k), "object", outside), 20).field.state_dict() for k, outside in enumerate((1.0, 0.1)))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_measurements_take_masks_off_unless_told(tmp_path: Path) -> None:
    scene = _scene(tmp_path, "object")
    measurements = measure({"mono": (SENSORS["mono"], scene.frames_of("mono"))}, scene.region)
    m = measurements["mono"]
    assert m.pixels == 6 * DISC.size and measurements.chosen.first_word.tolist() == [-1] and not m.has_opacity
