"""Run folders: ``runs/<scene>``, ``runs/<scene>-2``, ...; ``runs/latest`` is a link to the one that was fitted last."""

from __future__ import annotations

import os
from pathlib import Path

from mmsynth.errors import InputError

_RUNS = Path("runs")


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


def chosen_run(run: Path | None) -> Path:
    """The given run, or the latest one in this folder.

    Raises:
        InputError: none was given and nothing was fitted in this folder.
    """
    if run is not None:
        return run  # whether it is finished is for Field.load to find
    latest = _RUNS / "latest"
    if not latest.is_dir():
        raise InputError(f"{latest}: no finished fit in this folder; run `mmsynth fit SCENE` first.")
    return latest
