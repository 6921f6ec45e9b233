"""`mmsynth prior` and `fit --prior` as a user runs them, on the packaged example; fits too short to see much, long enough to be wired."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from few_looks import few_looks
from test_cli import here, refused

from mmsynth.workflows.runs import open_run

pytestmark = pytest.mark.usefixtures("decided_by_few_rays")


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of the example, a prior of it, and a fit of rgb that predicts the rest."""
    folder = tmp_path_factory.mktemp("prior")
    with pytest.MonkeyPatch.context() as patch:
        few_looks(patch)
        _make(folder)
    return folder


def _make(folder: Path) -> None:
    assert here(folder, "fit", "example", "--steps", "25", "--run", "all", "--json").returncode == 0
    made = here(folder, "prior", "all", "--out", "p.safetensors", "--json")
    assert json.loads(made.stdout) == {
        "prior": "p.safetensors",
        "scenes": ["example_scene"],
        "modalities": ["rgb", "nir", "mono", "pol", "ms"],
    }
    result = here(folder, "fit", "example", "--modalities", "rgb", "--prior", "p.safetensors", "--steps", "25", "--run", "few")
    assert result.returncode == 0 and "prior: on: nir, mono, pol, ms predicted from rgb, by 1 scene;" in result.stdout, result.stderr


def test_a_field_that_predicts_is_read_as_it_was_written(work: Path) -> None:
    first, again = open_run(work / "few"), open_run(work / "few")
    assert first.field.measured == ["rgb"] and first.field.predicted == ["nir", "mono", "pol", "ms"]
    frame = first.scene.frames_of("rgb")[0]
    seen, same = (r.field.render(frame.camera, r.field.pose_of(frame)) for r in (first, again))
    assert set(seen.deviation) == {"nir", "mono", "pol", "ms"}
    for name, light in seen.channels.items():
        np.testing.assert_array_equal(light, same.channels[name])
        if name != "rgb":
            inside = seen.valid
            assert np.isfinite(light[inside]).all() and (light[inside] >= 0).all() and (seen.deviation[name][inside] >= 0).all()
    # the analysers' intensities are those of the Stokes vectors
    np.testing.assert_allclose(seen.channels["pol"][..., [0, 2]].sum(-1), seen.stokes["pol"][..., 0], rtol=1e-4, atol=1e-6)


def test_what_is_predicted_is_marked(work: Path) -> None:
    scores = json.loads(here(work, "evaluate", "--run", "few", "--json").stdout)["modalities"]
    for name in ("nir", "mono", "pol", "ms"):
        assert scores[name]["predicted"] is True and "psnr" not in scores[name]
        assert {"psnr_aligned", "psnr_aligned_free_gain", "free_gain", "within_2sd"} <= set(scores[name])
        assert scores[name]["psnr_aligned_free_gain"] >= scores[name]["psnr_aligned"] - 1e-6
    assert "predicted" not in scores["rgb"]
    assert "nir *" in here(work, "evaluate", "--run", "few").stdout
    result = here(work, "convert", "--run", "few", "--from", "rgb", "--to", "ms", "--views", "9", "--out", "converted")
    assert result.returncode == 0, result.stderr
    assert json.loads((work / "converted/ms/0009.json").read_text())["predicted"] is True
    found = np.load(work / "converted/ms/0009.npz")
    assert found["predicted"] and found["deviation"].shape == found["data"].shape
    assert (work / "converted/ms/0009_predicted.png").is_file() and not (work / "converted/ms/0009.png").exists()
    (work / "orbit.json").write_text(json.dumps({"trajectory": "orbit", "views": 1}))
    made = here(work, "generate-dataset", "--run", "few", "--poses", "orbit.json", "--modalities", "rgb,pol", "--out", "set")
    assert made.returncode == 0, made.stderr
    about = json.loads((work / "set/dataset.json").read_text())
    assert "predicted" in json.dumps(about["modalities"]["pol"]) and "predicted" not in json.dumps(about["modalities"]["rgb"])
    assert {"data", "stokes", "deviation"} <= set(np.load(work / "set/views/0000/pol.npz").files)


def test_what_needs_a_real_sensor_refuses(work: Path) -> None:
    refused(here(work, "calibrate-noise", "--run", "few", "--modalities", "ms"), "ms is predicted by a prior", "expected one of rgb")
    refused(here(work, "simulate", "--run", "few", "--sensor", "mmsdata_mono", "--views", "9"), "mono is predicted by a prior")
    refused(here(work, "convert", "--run", "few", "--from", "ms", "--to", "rgb", "--views", "9"), "ms")


def test_a_few_frames_correct_the_prediction(work: Path) -> None:
    result = here(
        work, "fit", "example", "--frames", "nir=1,pol=1,mono=1,ms=1", "--prior", "p.safetensors", "--steps", "25", "--run", "one"
    )
    assert result.returncode == 0 and "nir: error at its 1 frame" in result.stdout, result.stderr
    run = open_run(work / "one")
    assert run.field.measured == ["rgb"] and set(run.field.corrected) == {"nir", "pol", "mono", "ms"}
    assert set(run.scene.sensors) == {"rgb", "nir", "mono", "pol", "ms"}  # of the frames that it has scores are made, too
    about = run.field.manifest["prior"]["corrections"]
    for facts in about.values():
        assert facts["frames"] == 1 and facts["after"] <= facts["before"]
    scores = json.loads(here(work, "evaluate", "--run", "one", "--json").stdout)["modalities"]
    assert "psnr" in scores["nir"] and scores["nir"]["predicted"] is True


def test_the_packaged_prior_serves_a_stranger(work: Path) -> None:
    result = here(work, "fit", "example", "--modalities", "rgb", "--prior", "default", "--steps", "5", "--run", "stranger", "--json")
    assert result.returncode == 0, result.stderr
    why = json.loads((work / "stranger/manifest.json").read_text())["needs"]["choices"]["prior"]["why"]
    assert "by 24 scenes" in why and "no exposure is stated" in why


def test_bad_priors_and_exposures_are_refused_before_the_fit(work: Path) -> None:
    refused(here(work, "fit", "example", "--prior", "nothing.safetensors"), "nothing.safetensors: no such file")
    (work / "broken.safetensors").write_bytes(b"broken")
    refused(here(work, "fit", "example", "--prior", "broken.safetensors"), "broken.safetensors")
    (work / "exposure.json").write_text('{"rgb": 0}')
    refused(here(work, "fit", "example", "--prior", "p.safetensors", "--exposure", "exposure.json"), "rgb: 0, expected a positive number")
    refused(here(work, "prior", "few", "--out", "q.safetensors"), "one modality")
    refused(here(work, "prior", str(work / "converted"), "--out", "q.safetensors"), "converted")
    assert not (work / "q.safetensors").exists()
