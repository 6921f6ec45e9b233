"""Many scenes on several GPUs: each process has its scenes and its device. torchrun's variables are set, GPUs and fits are made up."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mmsynth.errors import InputError
from mmsynth.fitting.recipe import Recipe
from mmsynth.operations.output.work_partition import local_device, partition_of_environment
from mmsynth.workflows import batch
from mmsynth.workflows.batch import SceneJob, run_batch

SCENES = [Path(name) for name in ("a", "b", "c", "d", "e")]


@pytest.fixture
def processes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[int, int, Any], list[tuple[str, str]]]:
    """So many processes, one after the other, on so many GPUs: the scene and device of each fit."""

    def run(count: int, gpus: int, fail: Any = None) -> list[tuple[str, str]]:
        fits: list[tuple[str, str]] = []
        current = [0]

        def fit(scene: Any, run: Path, **options: Any) -> Any:
            fits.append((scene.name, options["device"]))
            assert options["device"] == f"cuda:{current[0]}"  # what names no device means the process's own
            if fail is not None:
                raise fail
            return SimpleNamespace(manifest={"train_psnr": {"rgb": 30.0}})

        monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
        monkeypatch.setattr(torch.cuda, "set_device", lambda index: current.__setitem__(0, index))
        monkeypatch.setattr(batch, "load_scene", lambda path, **options: SimpleNamespace(name=path.name))
        monkeypatch.setattr(batch, "fit", fit)
        monkeypatch.setattr(batch, "write_run_report", lambda *args, **options: None)
        monkeypatch.setenv("WORLD_SIZE", str(count))
        for rank in range(count):
            monkeypatch.setenv("RANK", str(rank))
            monkeypatch.setenv("LOCAL_RANK", str(rank % gpus))
            run_batch(SCENES, tmp_path / f"{count}", SceneJob(Recipe(), device="cuda"), part=partition_of_environment())
        return fits

    return run


def test_every_scene_is_fitted_once_each_on_the_device_of_its_process(processes: Callable[..., list[tuple[str, str]]]) -> None:
    assert processes(5, 5) == [(s.name, f"cuda:{i}") for i, s in enumerate(SCENES)]


def test_more_scenes_than_processes_and_more_processes_than_gpus(processes: Callable[..., list[tuple[str, str]]]) -> None:
    for count, gpus in ((2, 2), (3, 2), (8, 4)):
        fits = processes(count, gpus)
        assert sorted(name for name, _ in fits) == [s.name for s in SCENES]
        assert {device for _, device in fits} <= {f"cuda:{i}" for i in range(gpus)}


def test_a_scene_that_is_too_large_for_a_gpu_is_told_in_a_sentence(processes: Callable[..., list[tuple[str, str]]], tmp_path: Path) -> None:
    assert len(processes(1, 1, torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate"))) == len(SCENES)
    told = (tmp_path / "1" / "a" / "outcome.json").read_text()
    assert "does not fit into the memory of one GPU, and a scene is not split over several" in told and "Tried" not in told


def test_a_local_rank_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOCAL_RANK", "first")
    assert local_device("cpu") == "cpu"
    with pytest.raises(InputError, match="LOCAL_RANK is 'first'"):
        local_device("cuda")
