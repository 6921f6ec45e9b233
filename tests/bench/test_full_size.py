"""Full-size scenes made of small ones, of a field that is known in closed form."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analytic import AnalyticField, scene_of, sphere

from mmsynth.bench.full_size import as_hard_as_pixels, full_size_camera, make_full_size, views_to_make
from mmsynth.errors import InputError
from mmsynth.field.kernels import Sampling
from mmsynth.scene.ground_truth import GroundTruth
from mmsynth.scene.images import load_frame
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene
from mmsynth.sensors.camera import project
from mmsynth.sensors.mosaic import photosites_of

WIDTH = 72  # three times that of the small scene


@pytest.fixture
def field() -> Any:
    return AnalyticField(sphere())


@pytest.fixture
def small(field: Any, tmp_path: Path) -> Scene:
    return scene_of(field, tmp_path / "small", views=6, truth=False)


def test_a_point_is_where_it_was_on_larger_pixels(field: Any, small: Scene, tmp_path: Path) -> None:
    made = load_scene(make_full_size(field, small, tmp_path / "large", width=WIDTH).parent)
    assert list(made.sensors) == list(small.sensors) and made.split.test == small.split.test and not made.problems
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    for ours, theirs in zip(made.frames, small.frames, strict=True):
        assert (ours.sensor, ours.view, ours.camera.width) == (theirs.sensor, theirs.view, WIDTH)
        assert ours.camera.coefficients.tolist() == theirs.camera.coefficients.tolist()
        large, little = (project((points - f.camera_to_world[:3, 3]) @ f.camera_to_world[:3, :3], f.camera) for f in (ours, theirs))
        # centres of pixels are whole numbers: the corner of the picture is at -0.5 in both
        np.testing.assert_allclose((large + 0.5) / 3, little + 0.5, atol=1e-9)


def test_truth_is_what_the_field_shows_and_frames_are_its_photosites(field: Any, small: Scene, tmp_path: Path) -> None:
    made = load_scene(make_full_size(field, small, tmp_path / "large", width=WIDTH, seed=3).parent)
    truth = GroundTruth(made)
    for frame in made.frames:
        sensor = made.sensors[frame.sensor]
        seen = field.render(frame.camera, frame.camera_to_world, [sensor.name])
        light = seen.channels[sensor.name]
        raw, _ = load_frame(sensor, frame)
        expected = light if sensor.mosaic is None else photosites_of(light, sensor.mosaic)
        # 12 bits of a well of 10,000 electrons, read noise of 5: five deviations
        assert np.abs(raw - expected).max() < 5 * np.sqrt((1e4 * expected.max() + 25) / 1e8 + (1 / 4095) ** 2 / 12)
        assert abs(float((raw - expected).mean())) < 1e-3 and (raw != expected).any()
        if frame.view in made.split.test:
            shown = seen.stokes.get(sensor.name, light)
            np.testing.assert_allclose(truth.image(frame), shown, atol=5e-4 * np.abs(shown).max())
            np.testing.assert_array_equal(truth.region(frame), seen.opacity > 0.5)
        else:
            assert truth.image(frame) is None


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_it_goes_on_where_it_was_and_grows(field: Any, small: Scene, tmp_path: Path) -> None:
    whole, part = tmp_path / "whole", tmp_path / "part"
    calls: list[tuple[int, int]] = []
    make_full_size(field, small, whole, width=WIDTH, progress=lambda done, total: calls.append((done, total)))
    assert calls[-1] == (1000, 1000) and [done for done, _ in calls] == sorted(done for done, _ in calls)
    make_full_size(field, small, part, width=WIDTH, views=3)
    before = set(contents(part))
    assert len(load_scene(part).frames) == 3 * len(small.sensors)
    (part / "gt" / "ms" / "0005.npz").write_bytes(b"cut off")
    (part / "modalities" / "rgb" / "0005.png").unlink()
    (part / "meta_data.json").unlink()  # it was killed before the end
    field.renders = 0
    make_full_size(field, small, part, width=WIDTH)
    # what was not there: a truth, a frame that was lost, and the frames of three more views
    assert field.renders == 2 + 3 * len(small.sensors)
    assert contents(part) == contents(whole) and before <= set(contents(whole))


def test_smaller_numbers_of_views_are_among_the_larger(field: Any, tmp_path: Path) -> None:
    scene = scene_of(field, tmp_path / "many", views=12, truth=False)
    chosen = [views_to_make(scene, count) for count in range(2, 13)]
    for (train, test), (more, tests) in itertools.pairwise(chosen):
        assert set(train) <= set(more) and set(test) <= set(tests)
    assert chosen[-1] == (scene.split.train, scene.split.test) == views_to_make(scene)
    few = np.sort(chosen[3][0])  # 4 of 11 training views
    assert np.diff(few).max() <= 4
    for count in (0, 1, 13):
        with pytest.raises(InputError, match="2 to 12"):
            views_to_make(scene, count)


def test_cameras_of_all_scales_see_the_same(field: Any) -> None:
    camera = field.cameras["rgb"]
    corner = lambda c: np.array([(-0.5 - c.cx) / c.fx, (-0.5 - c.cy) / c.fy])
    for scale in (1.0, 0.5, 0.25, 0.125):
        scaled = full_size_camera(camera, scale)
        assert scaled.width == round(2464 * scale)
        np.testing.assert_allclose(corner(scaled), corner(camera), atol=1e-12)


def test_surfaces_are_a_pixel_thick(field: Any, small: Scene) -> None:
    field.sampling = Sampling(sharpness=20.0, step=0.05, active_surface=1, active_radiance=1)
    camera = field.cameras["rgb"]
    distance = np.median([np.linalg.norm(frame.camera_to_world[:3, 3]) for frame in small.frames])
    for scale in (1.0, 0.5):
        larger = full_size_camera(camera, scale)
        hard = as_hard_as_pixels(field, small, dict.fromkeys(field.measured, larger))
        pixel = distance / (0.5 * (larger.fx + larger.fy))
        assert hard.sampling.sharpness * pixel == pytest.approx(4.0)
        assert hard.sampling.step * hard.sampling.sharpness == pytest.approx(1.0)  # as many samples in the soft part as before
        assert hard.sensors is field.sensors and field.sampling.sharpness == 20.0
    field.sampling = hard.sampling._replace(sharpness=1e6)
    assert as_hard_as_pixels(field, small, field.cameras) is field
