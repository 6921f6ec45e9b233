"""Hard cases of what comes between: signals, memory, disks, files that go away, kills; each ends a fit in a sentence, and it can go on."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from few_looks import few_looks
from small_scenes import QUICK, around, write_scene

from mmsynth.errors import InputError, Interrupted, OutOfMemoryError
from mmsynth.field.kernels import cpu
from mmsynth.field.kernels.cpu.compiled import KERNELS
from mmsynth.fitting import needs
from mmsynth.fitting.checkpoint import read_checkpoint
from mmsynth.fitting.progress import FitProgress
from mmsynth.fitting.run import fit
from mmsynth.fitting.trainer import Trainer
from mmsynth.scene.load import load_scene
from mmsynth.scene.scene import Scene

pytestmark = pytest.mark.usefixtures("decided_by_few_rays")

Row = Callable[[str, str, str], None]
STEPS = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("of") / "scene", {"rgb": around(6)})


@pytest.fixture(scope="module")
def scene(folder: Path) -> Scene:
    return load_scene(folder)


@pytest.fixture(scope="module")
def whole(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as monkeypatch:
        few_looks(monkeypatch)
        fit(scene, run, recipe=QUICK, steps=STEPS)
    return run


def at_step(step: int, do: Callable[[], object]) -> Callable[[FitProgress], None]:
    return lambda news: do() and None if news.step == step else None


def same_after_resuming(scene: Scene, run: Path, whole: Path) -> bool:
    """Whether the fit goes on to the field of one that nothing came between."""
    fit(scene, run, recipe=QUICK, steps=STEPS, resume=True)
    return (run / "field.safetensors").read_bytes() == (whole / "field.safetensors").read_bytes()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["SIGINT", "SIGTERM"])
def test_a_signal_ends_a_fit_after_its_step(row: Row, scene: Scene, whole: Path, tmp_path: Path, number: int, code: int) -> None:
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(Interrupted, match=r"^fit: stopped at step 3; --resume goes on from there in .*\.$") as stopped:
        fit(scene, tmp_path, recipe=QUICK, steps=STEPS, on_step=at_step(3, lambda: signal.raise_signal(number)))
    assert stopped.value.exit_code == code
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    saved = read_checkpoint(tmp_path)
    assert saved is not None and saved["state"]["step"] == 3
    assert same_after_resuming(scene, tmp_path, whole)
    row(f"{signal.Signals(number).name} in step 3", "up to 60 s are lost", "the step is finished and saved; resumed: the same field")


def test_a_second_signal_does_not_wait(scene: Scene, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as now:
        now.setattr(Trainer, "run_step", lambda self: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
        with pytest.raises(Interrupted, match=r"^fit: interrupted; --resume goes on from the last checkpoint in .*\.$"):
            fit(scene, tmp_path, recipe=QUICK, steps=STEPS)
    assert same_after_resuming(scene, tmp_path, whole)


@pytest.mark.parametrize("allocate", [lambda: np.empty(1 << 58), lambda: torch.empty(1 << 58), lambda: bytearray(1 << 60)],
                         ids=["numpy", "torch", "python"])  # fmt: skip
def test_out_of_memory_in_a_step(
    row: Row, scene: Scene, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest, allocate: Callable[[], object],
) -> None:  # fmt: skip
    """In the middle of a step, half of which is done: the checkpoint before it is what is gone on from."""
    with monkeypatch.context() as now:
        update = Trainer._update
        now.setattr(Trainer, "_update", lambda self, sampling: (update(self, sampling), self.state.step == 3 and allocate())[0])
        pattern = r"^fit: out of memory( \([^\n]*allocate[^\n]*\))?; --resume goes on from the last checkpoint in [^\n]*\.$"
        with pytest.raises(OutOfMemoryError, match=pattern) as full:
            fit(scene, tmp_path, recipe=QUICK, steps=STEPS, checkpoint_every=0.0)
    assert full.value.exit_code == 3
    assert same_after_resuming(scene, tmp_path, whole)
    row(f"no memory in a step ({request.node.callspec.id})", "a traceback", "one sentence, exit code 3; resumed: the same field")


@pytest.mark.parametrize("how", ["when it is flushed", "in the middle"])
def test_a_disk_that_fills_up(row: Row, scene: Scene, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    """While a checkpoint is written; the one before it is still there, whole."""

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def fill() -> None:
        if how == "in the middle":  # no file may be larger
            resource.setrlimit(resource.RLIMIT_FSIZE, (sizes[0] // 2, sizes[1]))
        else:
            now.setattr(os, "fsync", full)

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    sizes = (whole / "checkpoint" / "state.pt").stat().st_size, before[1]
    reason = os.strerror(errno.EFBIG if how == "in the middle" else errno.ENOSPC)
    with monkeypatch.context() as now:
        try:
            with pytest.raises(InputError, match=rf"could not be written \({reason}\)\.$"):
                fit(scene, tmp_path, recipe=QUICK, steps=STEPS, checkpoint_every=0.0, on_step=at_step(4, fill))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    saved = read_checkpoint(tmp_path)
    assert saved is not None and saved["state"]["step"] == 3 and not list(tmp_path.rglob(".*"))
    assert same_after_resuming(scene, tmp_path, whole)
    row(f"a disk that fills up while a checkpoint is written, {how}", "half a checkpoint", "that of before; resumed: the same field")


def test_a_run_folder_that_goes_away(row: Row, scene: Scene, whole: Path, tmp_path: Path) -> None:
    """It is made again: what is in memory is worth more."""
    run = tmp_path / "run"
    fit(scene, run, recipe=QUICK, steps=STEPS, on_step=at_step(3, lambda: shutil.rmtree(run)))
    for name in ("field.safetensors", "train.jsonl"):
        assert (run / name).is_file()
    assert (run / "field.safetensors").read_bytes() == (whole / "field.safetensors").read_bytes()
    row("the run folder removed while it is fitted", "an error at the next checkpoint", "made again, the same field")


def test_a_file_in_the_place_of_the_checkpoint(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "checkpoint").write_text("")
    with pytest.raises(InputError, match=r"state\.pt: could not be written \(.*\)\.$"):
        fit(scene, tmp_path, recipe=QUICK, steps=STEPS)


def test_what_killed_writers_left_is_cleared_away(scene: Scene, whole: Path, tmp_path: Path) -> None:
    (tmp_path / "checkpoint").mkdir()
    for name in (".field.123.tmp.safetensors", "checkpoint/.state.4567.tmp.pt"):
        (tmp_path / name).write_bytes(b"half")
    assert same_after_resuming(scene, tmp_path, whole)
    assert not list(tmp_path.rglob(".*"))


def test_a_field_is_not_vouched_for_by_the_manifest_of_another(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second fit into a run's folder that is killed between its field and its manifest."""
    fit(scene, tmp_path, recipe=QUICK, steps=STEPS)
    monkeypatch.setattr("mmsynth.field.storage.write_json", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        fit(scene, tmp_path, recipe=QUICK, steps=STEPS, seed=1)
    assert not (tmp_path / "manifest.json").exists()


def test_lamps_that_were_given_up_leave_nothing_in_a_checkpoint(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They would go on to be updated in the process that gave them up, and not in one that resumed."""
    monkeypatch.setattr(needs, "_FEW", 0)  # few views would keep them
    fit(scene, tmp_path, recipe=QUICK.with_changes({"radiance.light": "auto"}), steps=STEPS)
    saved = read_checkpoint(tmp_path)
    assert saved is not None and saved["state"]["light"] is not None and not saved["state"]["light"]["value"]
    assert not [n for n in (*saved["optimiser"]["moments"], *saved["average"]["means"]) if n.startswith("light.")]


def test_kernels_whose_code_was_not_written_are_not_taken_for_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that compiled them was killed between the index of the cache and the code that it lists."""
    (kernel,) = [k for k in KERNELS if k.py_func.__name__ == "shade"]
    monkeypatch.setattr(cpu.compiled, "KERNELS", (kernel,))
    monkeypatch.setattr(type(kernel), "signatures", [])
    assert cpu.is_compiled()
    monkeypatch.setattr(Path, "is_file", lambda self: self.suffix != ".nbc")
    assert not cpu.is_compiled()
