"""How commands end when something comes between: one sentence on stderr, an exit code that the README states, and nothing half-written."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from few_looks import few_looks
from test_cli import ROOT, here, refused

from mmsynth.fitting.checkpoint import read_checkpoint
from mmsynth.packaged import data_folder

FIT = ("fit", "scene", "--modalities", "mono", "--steps")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the example, and a run of it."""
    folder = tmp_path_factory.mktemp("work")
    shutil.copytree(data_folder("example_scene"), folder / "scene", ignore=shutil.ignore_patterns("gt"))
    with pytest.MonkeyPatch.context() as patch:
        few_looks(patch)
        assert here(folder, *FIT, "3").returncode == 0
    (folder / "poses.json").write_text('{"trajectory": "orbit", "views": 2}')
    (folder / "scenes.txt").write_text("scene\n")
    return folder


def ends(cwd: Path, args: tuple[str, ...], code: int, sentence: str) -> None:
    """A command of this process ends with this code and that sentence."""
    result = here(cwd, *args)
    lines = result.stderr.splitlines()
    assert result.returncode == code and len(lines) == 1 and sentence in lines[0], result.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["SIGINT", "SIGTERM"])
def test_a_signal_ends_a_fit_that_goes_on(fitted: Path, tmp_path: Path, number: int, code: int) -> None:
    """In a process of its own, whenever it comes after the first checkpoint."""
    command = [sys.executable, "-m", "mmsynth", *FIT, "1000000", "--run", str(tmp_path / "run"), "--json"]
    process = subprocess.Popen(command, cwd=fitted, env={**os.environ, "PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "run/checkpoint/state.pt").exists():
        assert process.poll() is None
        time.sleep(0.05)
    time.sleep(0.2)
    process.send_signal(number)
    said = process.communicate()[1].splitlines()
    assert process.returncode == code and len(said) == 1 and "--resume goes on from there" in said[0], said
    saved = read_checkpoint(tmp_path / "run")
    assert saved is not None and f"stopped at step {saved['state']['step']};" in said[0]


def test_a_signal_ends_any_command(fitted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, code, word in ((signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")):
        monkeypatch.setattr("mmsynth.workflows.runs.load_again", lambda *_, number=number, **__: signal.raise_signal(number))
        ends(fitted, ("evaluate",), code, word)
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


class _Signals:
    """A signal comes while this is destroyed, where Python ignores what is raised."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __del__(self) -> None:
        signal.raise_signal(self.number)


def _destroyed(number: int) -> None:
    _Signals(number)
    limit = time.monotonic() + 60.0
    while time.monotonic() < limit:
        time.sleep(0.01)


def test_a_signal_that_comes_while_something_is_destroyed_ends_a_command(fitted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The viewer went on after Ctrl-C: it had come while the memory of a kernel was given back."""
    for number, code, word in ((signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")):
        monkeypatch.setattr("mmsynth.workflows.runs.load_again", lambda *_, number=number, **__: _destroyed(number))
        before = sys.unraisablehook
        ends(fitted, ("evaluate",), code, word)
        assert sys.unraisablehook is before


def test_a_limit_of_memory(fitted: Path, tmp_path: Path) -> None:
    """The kernel refuses a process more memory than it has and 60 MB, before a scene is read."""
    code = """
import resource, sys
from mmsynth.cli import main
import mmsynth.workflows.fit
from mmsynth.field.warmup import warm_up
warm_up()
size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize() + 60_000_000
resource.setrlimit(resource.RLIMIT_AS, (size, size))
main()
"""
    command = [sys.executable, "-c", code, *FIT, "3", "--run", str(tmp_path / "run"), "--json"]
    done = subprocess.run(command, cwd=fitted, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    said = done.stderr.splitlines()
    assert done.returncode == 3 and len(said) == 1 and said[0].startswith("error: fit: out of memory"), done.stderr
    resumed = here(fitted, *FIT, "3", "--run", str(tmp_path / "run"), "--resume", "--json")
    assert resumed.returncode == 0 and json.loads(resumed.stdout)["steps"] == 3
    assert resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY


COMMANDS = {
    "evaluate": ("evaluate",),
    "convert": ("convert", "--from", "mono", "--to", "mono", "--out", "OUT"),
    "generate-dataset": ("generate-dataset", "--poses", "poses.json", "--out", "OUT"),
    "simulate": ("simulate", "--sensor", "mmsdata_mono", "--poses", "poses.json", "--out", "OUT"),
    "mesh": ("mesh", "--resolution", "24", "--out", "OUT/mesh.ply"),
    "video": ("video", "--poses", "poses.json", "--width", "32", "--show", "mono", "--out", "OUT/video.mp4"),
    "export": ("export", "--layout", "nerfstudio", "--out", "OUT"),
}


def command(name: str, out: Path) -> tuple[str, ...]:
    return tuple(word.replace("OUT", str(out)) for word in COMMANDS[name])


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("allocate", [lambda: np.empty(1 << 58), lambda: torch.empty(1 << 58)], ids=["numpy", "torch"])
def test_out_of_memory(fitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, allocate: object) -> None:
    monkeypatch.setattr("mmsynth.workflows.runs.load_field", lambda *_: allocate())  # type: ignore[operator]
    ends(fitted, command(name, tmp_path / "out"), 3, f"error: {name}: out of memory (")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", COMMANDS)
def test_a_scene_that_went_away(fitted: Path, tmp_path: Path, name: str) -> None:
    (fitted / "scene").rename(fitted / "elsewhere")
    try:
        refused(here(fitted, *command(name, tmp_path / "out")), "scene")
    finally:
        (fitted / "elsewhere").rename(fitted / "scene")
    assert not (tmp_path / "out").exists()


def test_a_frame_that_went_away(fitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the scene was looked at, before the frame is read."""
    shutil.copytree(fitted / "scene", tmp_path / "scene")
    from mmsynth.fitting import measurements

    read_frames, frame = measurements.read_frames, tmp_path / "scene/modalities/mono/0004.png"
    with monkeypatch.context() as now:
        now.setattr(measurements, "read_frames", lambda *of: frame.unlink(missing_ok=True) or read_frames(*of))
        refused(here(tmp_path, *FIT, "3"), "0004.png", "no such image file")
    assert not (tmp_path / "runs").exists()
    shutil.copy(fitted / "scene/modalities/mono/0004.png", frame)
    assert here(tmp_path, *FIT, "3").returncode == 0


def test_what_the_system_refuses_is_one_sentence(fitted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of any call that nobody thought of: the file, and what the system says."""
    monkeypatch.setattr("mmsynth.workflows.runs.load_again", lambda *_, **__: open(fitted / "nothing"))
    refused(here(fitted, "evaluate"), "nothing: No such file or directory.")


def test_a_defect_is_not_hidden(fitted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mmsynth.workflows.runs.load_again", lambda *_, **__: {}["missing"])
    with pytest.raises(KeyError, match="missing"):
        here(fitted, "evaluate")


def test_a_batch_that_is_out_of_memory_goes_on_with_the_next_scene(fitted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mmsynth.workflows.batch.fit", lambda *_, **__: torch.empty(1 << 58))
    refused(here(fitted, "batch", "scenes.txt", "--steps", "2", "--out", str(tmp_path), "--json"), "1 of 1 scenes failed", "out of memory")
    assert "out of memory" in json.loads((tmp_path / "scene/outcome.json").read_text())["error"]
