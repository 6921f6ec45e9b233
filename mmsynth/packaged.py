"""Files that travel with the package: recipes and the example scene."""

from __future__ import annotations

from pathlib import Path

_SOURCE = {"recipes": "recipes", "example_scene": "examples/example_scene"}


def data_folder(name: str) -> Path:
    """Folder of packaged data, ``recipes`` or ``example_scene``: in the wheel ``mmsynth/_data``, in a checkout beside ``mmsynth``."""
    here = Path(__file__).parent
    installed = here / "_data" / name
    return installed if installed.is_dir() else here.parent / _SOURCE[name]
