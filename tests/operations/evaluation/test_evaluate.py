"""Scores: exact on a field that is the truth, right on known errors, and never NaN."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic import MS, RGB, AnalyticField, WrongField, scene_of, sphere

from mmsynth.errors import InputError
from mmsynth.field import picture
from mmsynth.field.picture import Rendering
from mmsynth.operations.evaluation import visible_points
from mmsynth.operations.evaluation.evaluate import evaluate, raw_ssim
from mmsynth.report.text import score_text
from mmsynth.scene.image_writers import write_png16
from mmsynth.scene.images import load_frame
from mmsynth.scene.scene import MaskMeaning, Scene
from mmsynth.sensors.metrics import spectral_angle_deg


class Changed(AnalyticField):
    """The true field with a known error in it."""

    def __init__(self, change: Any, *args: Any) -> None:
        super().__init__(*args)
        self.change = change

    def render(self, *args: Any, **kwargs: Any) -> Rendering:
        out = super().render(*args, **kwargs)
        return replace(out, **self.change(out))


def score(field: AnalyticField, scene: Any, **kwargs: Any) -> dict[str, Any]:
    return evaluate(field, scene, **kwargs)  # type: ignore[arg-type]


def test_truth_scores_perfectly(tmp_path: Path) -> None:
    field = AnalyticField(sphere())
    calls: list[tuple[int, int]] = []
    result = score(field, scene_of(field, tmp_path), progress=lambda done, total: calls.append((done, total)))
    json.dumps(result, allow_nan=False)
    assert set(result) == {"modalities", "geometry", "views", "seconds", "rays_per_s"}
    assert result["views"] == [3] and result["rays_per_s"] > 0
    for name, scores in result["modalities"].items():
        assert scores["psnr"] > 90, name  # 16-bit rounding
        assert scores["ssim"] > 0.9999
        assert scores["foreground_from"] == "gt" and scores["psnr_foreground"] > 90
        assert scores["psnr_truth"] > 100 and scores["psnr_truth_full"] > 100
    assert set(result["modalities"]["pol"]) >= {"stokes_rmse", "dolp_rmse", "aolp_mae", "psnr_aligned"}
    assert result["modalities"]["pol"]["aolp_mae"] < 1e-4
    assert result["modalities"]["ms"]["sam"] < 1e-4
    assert "sam" not in result["modalities"]["rgb"]
    assert result["geometry"] == {
        "depth_mae": 0.0, "normal_mae_deg": 0.0, "normal_median_deg": 0.0, "hit_rate": 1.0, "chamfer_visible": 0.0,
    }  # fmt: skip
    assert calls == sorted(calls) and calls[-1][0] == calls[-1][1]


def test_scores_of_a_picture_by_bands_are_those_of_the_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, field = scene_of(AnalyticField(sphere()), tmp_path), WrongField(sphere())
    whole = score(field, scene)
    monkeypatch.setattr(picture, "_BAND", 5 * 24)  # rows of 18
    by_bands = score(field, scene)
    assert by_bands["geometry"] == whole["geometry"]
    for name, scores in whole["modalities"].items():
        figures = {key: value for key, value in scores.items() if isinstance(value, float)}
        assert {key: by_bands["modalities"][name][key] for key in figures} == pytest.approx(figures, rel=1e-6), name


def test_points_of_a_large_picture_are_some_of_its_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(AnalyticField(sphere()), tmp_path)
    shifted = Changed(lambda out: {"depth_z": out.depth_z + np.float32(0.01)}, sphere())
    whole = score(shifted, scene)["geometry"]
    monkeypatch.setattr(visible_points, "_POINTS", 24 * 18 // 4)
    some = score(shifted, scene)["geometry"]
    assert some["depth_mae"] == whole["depth_mae"] and some["chamfer_visible"] == pytest.approx(whole["chamfer_visible"], rel=0.25)
    assert score(AnalyticField(sphere()), scene)["geometry"]["chamfer_visible"] == 0.0


def test_known_errors(tmp_path: Path) -> None:
    scene = scene_of(AnalyticField(sphere()), tmp_path)

    def change(out: Rendering) -> dict[str, Any]:
        turn = np.radians(2 * 10.0)  # the AoLP by 10 degrees
        rotation = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]])
        depth = out.depth_z + 0.01
        depth[: len(depth) // 2] = np.nan
        return {
            "channels": {n: c + np.float32(0.1) for n, c in out.channels.items()},
            "stokes": {n: (s @ rotation.T) for n, s in out.stokes.items()},
            "depth_z": depth,
        }

    result = score(Changed(change, sphere()), scene)
    for scores in result["modalities"].values():
        assert scores["psnr"] == pytest.approx(20.0, abs=0.01)
        assert scores["psnr_truth"] == pytest.approx(20.0, abs=0.01)
    assert result["modalities"]["pol"]["aolp_mae"] == pytest.approx(10.0, abs=1e-3)
    assert result["modalities"]["pol"]["dolp_rmse"] < 1e-6
    assert result["geometry"]["depth_mae"] == pytest.approx(0.01, abs=1e-5)
    assert 0.2 < result["geometry"]["hit_rate"] < 0.8
    assert result["geometry"]["chamfer_visible"] > 0.01  # half of the surface is missing


def test_error_is_pooled_and_clipped(tmp_path: Path) -> None:
    """A prediction above full scale is what a clipping sensor shows as full scale."""
    field = AnalyticField(sphere(), [RGB])
    scene = scene_of(field, tmp_path)
    for frame in scene.frames:
        write_png16(frame.path, np.ones((frame.camera.height, frame.camera.width)))
    bright = Changed(lambda out: {"channels": {n: c + 5.0 for n, c in out.channels.items()}}, sphere(), [RGB])
    assert score(bright, scene)["modalities"]["rgb"]["psnr"] == pytest.approx(120.0)


def test_foreground_sources(tmp_path: Path) -> None:
    field = AnalyticField(sphere(), [RGB])
    scene = scene_of(field, tmp_path, truth=False)
    result = score(field, scene)
    assert result["modalities"]["rgb"]["foreground_from"] == "opacity"
    assert "psnr_truth" not in result["modalities"]["rgb"] and result["geometry"] == {}
    write_png16(tmp_path / "mask.png", np.eye(18, 24))
    masked = replace(scene, frames=tuple(replace(f, mask=tmp_path / "mask.png") for f in scene.frames))
    assert score(field, masked)["modalities"]["rgb"]["foreground_from"] == "masks"


def test_empty_mask_is_left_out(tmp_path: Path) -> None:
    field = AnalyticField(lambda p: np.full(p.shape[:-1], 1.0), [MS])
    result = score(field, scene_of(field, tmp_path, truth=False))
    assert "psnr_foreground" not in result["modalities"]["ms"]
    json.dumps(result, allow_nan=False)


def _masked(scene: Scene, masks: MaskMeaning, folder: Path, mask: np.ndarray) -> Scene:
    write_png16(folder / "mask.png", mask.astype(float))
    return replace(scene, masks=masks, frames=tuple(replace(f, mask=folder / "mask.png") for f in scene.frames))


def test_foreground_is_scored_pooled_and_as_the_mean_of_db_over_views(tmp_path: Path) -> None:
    """Errors of 0.1 in one view and of 0.001 in the other: 20 and 60 dB."""
    field = AnalyticField(sphere(), [RGB])
    scene = scene_of(field, tmp_path, truth=False)
    inside = np.zeros((18, 24), bool)
    inside[5:9, 7:13] = True
    errors = iter([0.1, 0.001])

    class Off(AnalyticField):
        def render(self, *args: Any, **kwargs: Any) -> Rendering:
            out, error = super().render(*args, **kwargs), next(errors)
            return replace(out, channels={n: c + error for n, c in out.channels.items()})

    found = score(Off(sphere(), [RGB]), _masked(scene, "off", tmp_path, inside), views=[2, 3])["modalities"]["rgb"]
    assert found["foreground_from"] == "masks"
    assert found["psnr_foreground"] == pytest.approx(-10 * np.log10((0.1**2 + 0.001**2) / 2), abs=0.02)
    assert found["psnr_foreground_view_mean"] == pytest.approx((20 + 60) / 2, abs=0.1)
    text = score_text({"modalities": {"rgb": found}})
    told = ("psnr", "psnr_view_mean", "psnr_foreground", "psnr_foreground_view_mean", "ssim")
    assert text.splitlines()[0].split() == "modality psnr [dB] view mean foreground view mean ssim".split()
    assert text.splitlines()[1].split() == ["rgb", *(f"{found[k]:.3f}" for k in told)]


def test_all_pixels_are_scored_pooled_and_as_the_mean_of_db_over_views(tmp_path: Path) -> None:
    field = AnalyticField(sphere(), [RGB])
    scene = scene_of(field, tmp_path, truth=False)
    errors = iter([0.1, 0.01])

    class Off(AnalyticField):
        def render(self, *args: Any, **kwargs: Any) -> Rendering:
            out, error = super().render(*args, **kwargs), next(errors)
            return replace(out, channels={n: c + error for n, c in out.channels.items()})

    found = score(Off(sphere(), [RGB]), scene, views=[2, 3])["modalities"]["rgb"]
    assert found["psnr"] == pytest.approx(-10 * np.log10((0.1**2 + 0.01**2) / 2), abs=0.02)
    assert found["psnr_view_mean"] == pytest.approx((20 + 40) / 2, abs=0.1)


def test_a_scene_may_record_other_photosites_than_the_field_learned_from(tmp_path: Path) -> None:
    """A field that learned demosaicked frames is scored on raw ones."""
    scene = scene_of(AnalyticField(sphere(), [MS]), tmp_path, truth=False)
    learned = AnalyticField(sphere(), [replace(MS, mosaic=None)])
    assert score(learned, scene)["modalities"]["ms"]["psnr"] > 90
    with pytest.raises(InputError, match=f"'ms' has {MS.channel_count} channels, expected the 2"):
        score(AnalyticField(sphere(), [replace(MS, channels=("a", "b"), wavelengths_nm=(None, None), mosaic=None)]), scene)


def test_lpips_is_of_demosaicked_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    field = AnalyticField(sphere(), [RGB, MS])
    scene = scene_of(field, tmp_path)
    assert "lpips" not in score(field, scene)["modalities"]["rgb"]  # frames of 24x18, if it is installed at all
    shapes = []

    def distance(a: torch.Tensor, b: torch.Tensor) -> float:
        shapes.append((tuple(a.shape), tuple(b.shape)))
        return float((a - b).abs().max())

    monkeypatch.setattr("mmsynth.operations.evaluation.evaluate.find_lpips", lambda: distance)
    assert "lpips" not in score(field, scene)["modalities"]["rgb"] and not shapes
    monkeypatch.setattr("mmsynth.operations.evaluation.evaluate.LARGE_ENOUGH", 18)
    found = score(field, scene)["modalities"]
    assert {shape for pair in shapes for shape in pair} == {(3, 18, 24)} and len(shapes) == 1 + MS.channel_count
    assert 0 <= found["rgb"]["lpips"] < 1e-4 and 0 <= found["ms"]["lpips"] < 1e-4  # 16-bit rounding
    brighter = Changed(lambda out: {"channels": {n: c + 0.1 for n, c in out.channels.items()}}, sphere(), [RGB, MS])
    assert score(brighter, scene)["modalities"]["ms"]["lpips"] == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize(("masks", "black", "counts"), [("object", True, True), ("ignore", False, False), ("off", False, True)])
def test_what_is_outside_a_mask_is_black_or_not_scored_or_as_recorded(
    masks: MaskMeaning, black: bool, counts: bool, tmp_path: Path
) -> None:
    """Frames whose outside was painted white, by two fields: one black there, one white."""
    inside = np.zeros((18, 24), bool)
    inside[5:13, 7:17] = True
    field = AnalyticField(sphere(), [RGB])
    scene = scene_of(field, tmp_path, truth=False)
    for frame in scene.frames:
        write_png16(frame.path, np.where(inside, load_frame(RGB, frame)[0], 1.0))
    scene = _masked(scene, masks, tmp_path, inside)

    def psnr(light: float) -> dict[str, Any]:
        paint = lambda out: {"channels": {n: np.where(inside[..., None], c, light) for n, c in out.channels.items()}}
        return score(Changed(paint, sphere(), [RGB]), scene)["modalities"]["rgb"]

    dark, bright = psnr(0.0), psnr(1.0)
    assert dark["psnr_foreground"] > 90 and bright["psnr_foreground"] > 90
    assert (dark["psnr"] > 90) == (black or not counts) and (bright["psnr"] > 90) == (not black)


def test_masks_that_are_all_empty_are_refused(tmp_path: Path) -> None:
    field = AnalyticField(sphere(), [RGB])
    scene = _masked(scene_of(field, tmp_path), "off", tmp_path, np.zeros((18, 24)))
    with pytest.raises(InputError, match=r"mask.png: this mask of rgb and those of all its other test frames are empty"):
        score(field, scene)


def test_views(tmp_path: Path) -> None:
    field = AnalyticField(sphere(), [RGB])
    scene = scene_of(field, tmp_path)
    assert score(field, scene, views=[0, 2])["views"] == [0, 2]
    with pytest.raises(InputError, match="view 77"):
        score(field, scene, views=[0, 77])


def test_damaged_truth(tmp_path: Path) -> None:
    field = AnalyticField(sphere(), [RGB])
    scene = scene_of(field, tmp_path)
    (tmp_path / "gt/rgb/0003.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match=r"gt.rgb.0003\.npz: damaged"):
        score(field, scene)


def test_ssim_never_sees_the_mosaic() -> None:
    """Channels of very different levels make the interleaved image a checkerboard; sub-frames are smooth."""
    ramp = np.linspace(0.2, 0.8, 40)[None, :] * np.ones((40, 1))
    gains = np.array([[1.0, 0.1], [0.5, 1.0]])
    raw = ramp * np.tile(gains, (20, 20))
    noisy = raw + 0.05 * np.random.default_rng(0).standard_normal(raw.shape)
    values = raw_ssim(raw, noisy, np.ones(raw.shape, bool), RGB)
    assert len(values) == 4 and all(v < 0.9 for v in values)
    assert raw_ssim(raw, raw, np.ones(raw.shape, bool), RGB) == pytest.approx([1.0] * 4)
    tiny = np.ones((9, 9))
    assert len(raw_ssim(tiny, tiny, np.ones((9, 9), bool), MS)) == 9  # 3 x 3 sub-frames
    assert raw_ssim(tiny[:5, :5], tiny[:5, :5], np.ones((5, 5), bool), MS) == []


def test_small_spectral_angles_are_exact() -> None:
    """arccos of the normalised dot product gives 0 or 0.02 degrees here in float32."""
    a = np.array([1.0, 1.0, 1.0])
    b = a + 1e-6 * np.array([1.0, 0.0, -1.0])
    assert spectral_angle_deg(a, b) == pytest.approx(np.degrees(1e-6 * np.sqrt(2 / 3)), rel=1e-4)
    assert np.isnan(spectral_angle_deg(a, 0 * a))
