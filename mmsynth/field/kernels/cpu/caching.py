"""Where compiled kernels are kept: apart for every version of their sources.

Numba knows for each function whether its own file changed, and not the files of what it inlines: after an update a kernel would go on
with parts of the old ones.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from numba import config
from numba.misc.appdirs import AppDirs

from mmsynth.files import write_atomic


def version_of_sources(folder: Path) -> str:
    """Of the kernels in a folder, and of the numbers that they share with others beside it."""
    digest = hashlib.sha256()
    for path in sorted([*folder.glob("*.py"), *folder.parent.glob("*.py")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


_VERSIONS = 3  # kept beside each other: those of other trees that share the folder, and of the last change taken back


def remove_old_versions(folder: Path) -> None:
    """Leave the last few versions beside this one, the folder of its kernels."""
    versions = [path for path in folder.parent.glob("kernels-*") if path != folder and path.is_dir()]
    for path in sorted(versions, key=lambda path: path.stat().st_mtime, reverse=True)[_VERSIONS - 1 :]:
        shutil.rmtree(path, ignore_errors=True)


def publish(made: Path, kept: Path, name: str) -> None:
    """Put the code of a function from one folder of a cache into another, its index last; nothing where there is none.

    Of two processes that compile into one folder, each may give its code a name that it does not know the other has taken, and an index
    then leads to code of other types. So they compile apart.

    Args:
        name: of its index, without the ending.
    """
    if (made / f"{name}.nbi").is_file():
        for path in [*made.glob(f"{name}.*.nbc"), made / f"{name}.nbi"]:
            write_atomic(kept / path.name, functools.partial(shutil.copyfile, path))


@contextmanager
def kept_by_version(folder: Path) -> Iterator[None]:
    """Kernels that are defined meanwhile keep their code in a folder of this version: in numba's own cache folder if one is set, beside the
    sources, or where nothing may be written there, with the user's caches."""
    before = config.CACHE_DIR
    beside = folder / "__pycache__"
    beside = beside if os.access(beside if beside.exists() else folder, os.W_OK) else Path(AppDirs("mmsynth").user_cache_dir)
    config.CACHE_DIR = str((Path(before) if before else beside) / f"kernels-{version_of_sources(folder)}")
    try:
        yield
    finally:
        config.CACHE_DIR = before
