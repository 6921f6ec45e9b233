"""A pixel's answer: the field's own light, the frames that saw it, and nothing that stands in the way."""

from __future__ import annotations

import numpy as np
import pytest
from analytic import AnalyticField, ring_pose, scene_of, sphere

from mmsynth.scene.scene import Scene
from mmsynth.sensors.camera import project, ray_map
from mmsynth.viewer.pixel import answer_html, ask, crop

FIELD = AnalyticField(sphere(), mirrored=0.2)
CAMERA, POSE = FIELD.cameras["rgb"], ring_pose(0, 6)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return scene_of(FIELD, tmp_path_factory.mktemp("scene"), views=6)


def test_it_is_what_the_field_renders_there() -> None:
    directions, _ = ray_map(CAMERA)
    rendered = FIELD.render(CAMERA, POSE)
    answer = ask(FIELD, POSE, directions[8, 13])
    for name, light in rendered.channels.items():
        if name in rendered.stokes:
            np.testing.assert_allclose(answer.stokes[name], rendered.stokes[name][8, 13], rtol=1e-6)
        else:
            np.testing.assert_allclose([b.light for b in answer.bands if b.modality == name], light[8, 13], rtol=1e-6)
    assert answer.depth == pytest.approx(float(rendered.depth_ray[8, 13]))
    np.testing.assert_allclose(np.linalg.norm(answer.point), 0.6, atol=1e-3)  # on the sphere
    np.testing.assert_allclose(answer.normal, rendered.normal[8, 13], atol=1e-6)
    assert answer.specular["rgb"] == pytest.approx(0.2, rel=0.5)


def test_frames_that_see_the_point_and_no_others(scene: Scene) -> None:
    directions, _ = ray_map(CAMERA)
    answer = ask(FIELD, POSE, directions[8, 13], scene)
    assert answer.point is not None and answer.sightings
    for frame in scene.frames:
        local = frame.camera_to_world[:3, :3].T @ (answer.point - frame.camera_to_world[:3, 3])
        u, v = project(local[None], frame.camera)[0]
        within = -0.5 <= u < frame.camera.width - 0.5 and -0.5 <= v < frame.camera.height - 0.5
        faces = (frame.camera_to_world[:3, 3] - answer.point) @ answer.point  # outward, of a sphere around the origin
        found = [s for s in answer.sightings if s.frame is frame]
        if abs(faces) > 0.05:  # the rim sees it or not
            assert bool(found) == (bool(within) and faces > 0 and frame.view in scene.split.train), (frame.sensor, frame.view)
        for sighting in found:
            np.testing.assert_allclose(sighting.pixel, (u, v), atol=1e-6)
    distances = [s.distance for s in answer.sightings]
    assert distances == sorted(distances)


def test_a_ray_that_meets_nothing_has_light_and_no_place() -> None:
    answer = ask(FIELD, POSE, np.array([0.0, -0.6, 0.8]))
    assert answer.point is None and answer.depth is None and not answer.sightings and answer.bands
    assert "Nothing is met" in answer_html(FIELD, answer, None)


def test_the_page_has_the_numbers_and_marks_what_is_predicted(scene: Scene) -> None:
    directions, _ = ray_map(CAMERA)
    answer = ask(FIELD, POSE, directions[8, 13], scene)
    page = answer_html(FIELD, answer, lambda frame: np.zeros((18, 24, 3), np.uint8), 0.75)
    for band in answer.bands:
        assert f"{band.light:.4f}" in page
    assert page.count("<img") >= 3 and "0.750" in page and "predicted" not in page
    predicted = AnalyticField(sphere(), mirrored=0.2)
    predicted.predicted = ["ms"]
    assert "predicted by a prior" in answer_html(predicted, ask_with_deviation(predicted, directions[8, 13]), None)


def ask_with_deviation(field: AnalyticField, direction: np.ndarray) -> object:
    cast = field.cast
    field.cast = lambda *a, **k: (seen := cast(*a, **k)) | {"deviation/ms": 0.1 * seen["ms"]}  # type: ignore[method-assign]
    answer = ask(field, POSE, direction)
    assert all((band.deviation is not None) == (band.modality == "ms") for band in answer.bands)
    return answer


@pytest.mark.parametrize("pixel", [(0.0, 0.0), (23.4, 17.4), (11.6, 8.2)])
def test_crops_are_centred_and_black_beyond_the_picture(pixel: tuple[float, float]) -> None:
    picture = np.full((18, 24, 3), 7, np.uint8)
    picture[round(pixel[1]), round(pixel[0])] = (200, 100, 50)
    found = crop(picture, pixel)
    assert found.shape == (25, 25, 3) and found[12, 12].tolist() == [200, 100, 50]
    assert (found[0, 0] == (0 if pixel[0] < 12 or pixel[1] < 12 else 7)).all()
