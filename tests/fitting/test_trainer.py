"""The trainer on the packaged example scene, a few steps at a time."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from mmsynth.data import data_folder
from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.fitting import trainer as trainer_module
from mmsynth.fitting.losses import photometric, residual
from mmsynth.fitting.measurements import load_measurements
from mmsynth.fitting.recipe import Recipe, load_recipe
from mmsynth.fitting.trainer import Trainer, fit
from mmsynth.operations.evaluate import evaluate
from mmsynth.scene.images import load_frame
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene

SMALL = Recipe(
    samples_per_step=2048, rays_at_start=128, radiance_rows_log2=12, surface_rows_log2=12, occupancy_resolution=24, eikonal_points=128
)  # type: ignore[call-arg]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(data_folder("example_scene"))


def _tensors(field: Field) -> dict[str, torch.Tensor]:
    return {k: v.clone() for k, v in field.state_dict().items()}


def test_a_fit_learns_and_its_run_gives_the_same_field_back(scene: Scene, tmp_path: Path) -> None:
    field = fit(scene, tmp_path / "run", SMALL, steps=300)
    assert set(field.sensors) == {"rgb", "nir", "mono", "pol", "ms"}
    for name, scores in evaluate(field, scene)["modalities"].items():
        raw = np.concatenate([load_frame(field.sensors[name], f)[0].ravel() for f in scene.frames_of(name, scene.split.test)])
        assert scores["psnr"] > -10 * np.log10(raw.var()) + 2, name  # 2 dB above the best flat picture
    again = Field.load(tmp_path / "run")
    frame = scene.frames_of("rgb", scene.split.test)[0]
    a, b = (f.render(frame.camera, frame.camera_to_world, ["rgb", "pol"]) for f in (field, again))
    np.testing.assert_array_equal(a.channels["rgb"], b.channels["rgb"])
    np.testing.assert_array_equal(a.stokes["pol"], b.stokes["pol"])
    assert a.channels["rgb"].shape == (frame.camera.height, frame.camera.width, 3)
    hit = np.isfinite(a.depth_z)
    assert hit.any() and (a.depth_ray[hit] >= a.depth_z[hit]).all()
    np.testing.assert_allclose(np.linalg.norm(a.normal[hit], axis=-1), 1.0, atol=1e-5)


def test_a_killed_fit_resumes_to_the_same_field(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _tensors(fit(scene, tmp_path / "whole", SMALL, steps=24, seed=3))
    monkeypatch.setattr(trainer_module, "CHECKPOINT_SECONDS", 0.0)

    class Killed(Exception):
        pass

    def kill(news: trainer_module.Progress) -> None:
        if news.step == 13:
            raise Killed

    with pytest.raises(Killed):
        fit(scene, tmp_path / "cut", SMALL, steps=24, seed=3, on_step=kill)
    assert not (tmp_path / "cut" / "manifest.json").exists()
    steps = []
    resumed = fit(scene, tmp_path / "cut", SMALL, seed=3, resume=True, on_step=lambda n: steps.append(n.step))
    assert steps[0] == 13 and steps[-1] == 24  # the checkpoint of step 12 was the last before the kill
    for name, value in _tensors(resumed).items():
        assert torch.equal(value, whole[name]), name


def test_the_seed_decides_the_field(scene: Scene, tmp_path: Path) -> None:
    a, b, c = (_tensors(fit(scene, tmp_path / str(i), SMALL, steps=6, seed=s)) for i, s in enumerate((0, 0, 1)))
    assert torch.equal(a["appearance.table"], b["appearance.table"])
    assert not torch.equal(a["appearance.table"], c["appearance.table"])


def test_a_checkpoint_of_another_fit_is_refused(scene: Scene, tmp_path: Path) -> None:
    fit(scene, tmp_path, SMALL, steps=3)
    with pytest.raises(InputError, match="seed"):
        fit(scene, tmp_path, SMALL, steps=3, seed=1, resume=True)
    with pytest.raises(InputError, match="steps"):
        fit(scene, tmp_path, SMALL, steps=5, resume=True)
    (tmp_path / "checkpoint" / "state.pt").write_bytes(b"broken")
    with pytest.raises(InputError, match="not a readable checkpoint"):
        fit(scene, tmp_path, SMALL, steps=3, resume=True)


def test_modalities_get_equal_rays_and_mosaics_one_channel(scene: Scene) -> None:
    trainer = Trainer(scene, SMALL, 5, None, 0, "cpu")
    random = np.random.default_rng(0)
    for name, m in trainer.measurements.items():
        batch = m.batch(300, random, torch.device("cpu"))
        assert batch.target.shape == (300, 1)
        mosaic = scene.sensors[name].mosaic
        assert (batch.channel is None) == (mosaic is None)
        if batch.channel is not None:
            assert set(batch.channel.tolist()) == set(np.unique(mosaic))
        assert (batch.axes is not None) == scene.sensors[name].is_polarization
        torch.testing.assert_close(batch.directions.norm(dim=1), torch.ones(300))


def test_a_batch_reads_the_pixel_its_ray_goes_through(scene: Scene) -> None:
    from mmsynth.sensors.camera import project

    m = Trainer(scene, SMALL, 5, None, 0, "cpu").measurements["ms"]
    frames = scene.frames_of("ms", scene.split.train)
    random = np.random.default_rng(1)
    frame, pixel = m.pick(50, random)
    origins, directions = m.rays(frame, pixel)
    values, _ = m.read(frame, pixel)
    for i in range(50):
        f = frames[frame[i]]
        in_camera = f.camera_to_world[:3, :3].T @ directions[i]
        u, v = project(in_camera[None].astype(np.float64), f.camera)[0]
        row, column = divmod(int(pixel[i]), f.camera.width)
        assert abs(u - column) < 1e-3 and abs(v - row) < 1e-3
        assert values[i, 0] == load_frame(m.sensor, f)[0][row, column]
        world = origins[i] * scene.region.radius + np.array(scene.region.centre)
        np.testing.assert_allclose(world, f.camera_to_world[:3, 3], atol=1e-5)


def test_only_needed_parts_are_built(scene: Scene) -> None:
    trainer = Trainer(scene, SMALL, 5, None, 0, "cpu")
    assert trainer.field.background is None and "not black" in trainer.needs.evidence["background"]
    forced = Trainer(scene, SMALL.model_copy(update={"background": "on"}), 5, None, 0, "cpu")
    assert forced.field.background is not None
    rgb = load_scene(data_folder("example_scene"), ["rgb"])
    assert Trainer(rgb, SMALL, 5, None, 0, "cpu").needs.evidence["tensor_head"].startswith("off")


def test_saturated_targets_only_pull_upwards() -> None:
    difference = residual(torch.tensor([1.5, 0.5, 1.5]), torch.tensor([1.0, 1.0, 0.9]), 0.998)
    torch.testing.assert_close(difference, torch.tensor([0.0, -0.5, 0.6]))


def test_dark_modalities_weigh_as_much_as_bright_ones() -> None:
    relative = torch.linspace(-0.4, 0.4, 9)
    assert photometric(relative * 1e-3, 1e-3) == pytest.approx(float(photometric(relative, 1.0)), rel=1e-5)


def test_recipes() -> None:
    for path in data_folder("recipes").glob("*.toml"):
        load_recipe(path.stem)
    with pytest.raises(InputError, match="expected one of"):
        load_recipe("nonsense")


def test_bad_recipe_files(tmp_path: Path) -> None:
    path = tmp_path / "r.toml"
    for text, message in (("speed = 3", "speed"), ("eikonal = -1", "eikonal"), ("eikonal = ", "not valid TOML")):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            load_recipe(str(path))


def test_alpha_premultiplies_colours_and_becomes_opacity(write_transforms: Callable[..., Path]) -> None:
    root = write_transforms(channels=3)
    for i, path in enumerate(sorted((root / "images").glob("*.png"))):
        assert cv2.imwrite(str(path), np.random.default_rng(i).integers(0, 256, (18, 24, 4), np.uint8))
    scene = load_scene(root)
    m = load_measurements(scene)["rgb"]
    batch = m.batch(200, np.random.default_rng(0), torch.device("cpu"))
    assert batch.alpha is not None
    pixels, alpha = load_frame(m.sensor, scene.frames_of("rgb", scene.split.train)[0])
    assert alpha is not None
    values, opacity = m.read(np.zeros(alpha.size, np.int64), np.arange(alpha.size))
    np.testing.assert_allclose(opacity, alpha.ravel(), atol=1e-6)
    np.testing.assert_allclose(values, (pixels * alpha[..., None]).reshape(-1, 3), atol=1e-6)


def test_detail_follows_the_pixels_and_what_the_fit_can_see_of_them(scene: Scene) -> None:
    long, short = (Trainer(scene, SMALL, steps, None, 0, "cpu").needs for steps in (100_000, 20))
    cameras = [f.camera for f in scene.frames]
    distance = np.median([np.linalg.norm(f.camera_to_world[:3, 3] - scene.region.centre) for f in scene.frames]) / scene.region.radius
    assert long.footprint == pytest.approx(distance / np.median([c.fx for c in cameras]), rel=0.02)
    assert short.footprint > 2 * long.footprint
    assert short.design.surface_finest <= long.design.surface_finest and short.sharpness_end < long.sharpness_end
