"""Runs: the folders that fits leave, and opening them again.

Folders are ``runs/<scene>``, ``runs/<scene>-2``, ... in the working folder; ``runs/latest`` is a link to the one that was fitted last.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mmsynth.errors import InputError
from mmsynth.field.field import Field
from mmsynth.field.storage import load_field
from mmsynth.scene.load import load_again
from mmsynth.scene.scene import MaskMeaning, Scene

_RUNS = Path("runs")
_FACTS = ("steps", "seconds", "train_psnr", "rays_per_s", "samples_per_s")


@dataclass(frozen=True)
class Run:
    """A finished fit: its folder, the field, and the scene that it was fitted to."""

    folder: Path
    field: Field
    scene: Scene

    def facts(self) -> dict[str, Any]:
        """Its folder, length and speed, and PSNR on training pixels [dB], ready for JSON."""
        return {"run": str(self.folder), **{k: self.field.manifest[k] for k in _FACTS}}


def open_field(folder: Path | None = None, *, device: str = "cpu") -> tuple[Path, Field]:
    """Folder and field of a run; None: the latest in the working folder.

    Raises:
        InputError: there is no such run, or nothing was fitted in the working folder.
    """
    folder = folder or latest_run()
    return folder, load_field(folder, device)


def open_run(folder: Path | None = None, *, device: str = "cpu", masks: MaskMeaning | None = None, mask_folder: Path | None = None) -> Run:
    """``open_field``, and the scene from where it was when it was fitted, with its masks.

    Args:
        masks, mask_folder: see ``use_masks``; None: as they were for the fit.
    Raises:
        InputError: as ``open_field``, or the scene or its masks cannot be read.
    """
    folder, field = open_field(folder, device=device)
    scene = load_again(field.manifest["scene"], modalities=[*field.measured, *field.corrected], masks=masks, mask_folder=mask_folder)
    return Run(folder, field, scene)


def is_run(folder: Path) -> bool:
    """Whether a fit wrote this folder."""
    return (folder / "field.safetensors").is_file()


def new_run(scene_name: str) -> Path:
    """A run folder that does not exist yet; nothing is created."""
    count = 1
    while (path := _RUNS / (scene_name if count == 1 else f"{scene_name}-{count}")).exists():
        count += 1
    return path


def run_to_resume(scene_name: str) -> Path:
    """The run of this scene whose checkpoint is the newest.

    Raises:
        InputError: there is none.
    """
    found = [p for pattern in (scene_name, f"{scene_name}-*") for p in _RUNS.glob(f"{pattern}/checkpoint/state.pt")]
    if not found:
        raise InputError(f"{_RUNS / scene_name}: no checkpoint to resume; run without --resume, or name the run with --run.")
    return max(found, key=lambda p: p.stat().st_mtime).parent.parent


def mark_latest(run: Path) -> None:
    """Point ``runs/latest`` at a finished run."""
    _RUNS.mkdir(exist_ok=True)
    link, temporary = _RUNS / "latest", _RUNS / f".latest.{os.getpid()}"
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(os.path.relpath(run, _RUNS), target_is_directory=True)
    os.replace(temporary, link)


def latest_run() -> Path:
    latest = _RUNS / "latest"
    if not latest.is_dir():
        raise InputError(f"{latest}: no finished fit in this folder; run `mmsynth fit SCENE` first.")
    return latest
