"""A scene whose metadata do not say where its pictures are, from ``info`` to ``evaluate``, as a user runs them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import OPENCV_TO_OPENGL, ring
from typer.testing import CliRunner

from mmsynth.cli import app


def _scene(root: Path) -> Path:
    """Split files that name rgb/0000 ..., pictures with alpha in cache/rgba and cache/nir, a black ball with a disc on it."""
    for split, poses in (("train", ring(6, 3.0, 1.0)), ("test", ring(2, 3.0, -1.0))):
        frames = []
        for index, pose in enumerate(poses):
            name = f"{split}{index:04d}"
            frames.append({"file_path": f"rgb/{name}", "transform_matrix": (pose @ OPENCV_TO_OPENGL).tolist()})
            for folder in ("rgba", "nir"):
                (root / "cache" / folder).mkdir(parents=True, exist_ok=True)
                image = np.zeros((24, 32, 4), np.uint8)
                cv2.circle(image, (16, 12), 7, (90, 90, 90, 255), -1)
                cv2.imwrite(str(root / "cache" / folder / f"{name}.webp"), image)
        meta = {"camera_angle_x": 0.8, "w": 64.0, "h": 48.0, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(meta))
    return root


def test_one_line_of_options_is_remembered_by_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = _scene(tmp_path / "scene")
    monkeypatch.chdir(tmp_path)
    options = ("scene", "--images", "cache/rgba", "--also", "nir=cache/nir", "--layout", "blender")
    said = CliRunner().invoke(app, ["info", *options, "--json"])
    assert said.exit_code == 0, said.output
    told = json.loads(said.stdout)
    assert told["format"] == "Blender" and {name: sensor["frames"] for name, sensor in told["sensors"].items()} == {"rgb": 8, "nir": 8}
    fitted = CliRunner().invoke(app, ["fit", *options, "--steps", "3", "--json"])
    assert fitted.exit_code == 0, fitted.output
    scores = CliRunner().invoke(app, ["evaluate", "--json"])
    assert scores.exit_code == 0, scores.output
    assert set(json.loads(scores.stdout)["modalities"]) == {"rgb", "nir"}
    manifest = json.loads((tmp_path / "runs" / "latest" / "manifest.json").read_text())
    assert manifest["scene"]["images"] == str(root / "cache" / "rgba") and manifest["scene"]["also"] == {"nir": str(root / "cache" / "nir")}


def test_export_reads_what_info_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _scene(tmp_path / "scene")
    monkeypatch.chdir(tmp_path)
    options = [
        "scene",
        "--images",
        "cache/rgba",
        "--also",
        "nir=cache/nir",
        "--masks",
        "ignore",
        "--out",
        "written",
        "--layout",
        "nerfstudio",
    ]
    written = CliRunner().invoke(app, ["export", *options])
    assert written.exit_code == 0, written.output
    told = json.loads(CliRunner().invoke(app, ["info", "written", "--json"]).stdout)
    assert {name: sensor["frames"] for name, sensor in told["sensors"].items()} == {"rgb": 8, "nir": 8} and told["masks"] == "ignore"
    assert CliRunner().invoke(app, ["fit", "written", "--steps", "2", "--json"]).exit_code == 0
    said = CliRunner().invoke(app, ["export", "--images", "cache/rgba", "--layout", "colmap"])
    assert said.exit_code == 2 and "expected them with a scene" in said.stderr and len(said.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), ("none of the 8 frames", "--images FOLDER")),
        (("--also", "nir"), ("--also 'nir'", "nir=FOLDER")),
        (("--images", "nowhere"), ("nowhere: no such file or folder",)),
        (("--layout", "colmap"), ("no sparse/0 in it",)),
    ],
)
def test_one_sentence_for_what_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], words: tuple[str, ...]
) -> None:
    _scene(tmp_path / "scene")
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["info", "scene", *options])
    assert result.exit_code == 2 and result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ") and all(word in line for word in words), line
