"""Where compiled kernels are kept: with the user's caches, apart for every version of their sources.

Numba knows for each function whether its own file changed, and not the files of what it inlines: after an update a kernel would go on
with parts of the old ones. And it keeps code apart for each place where sources lie, though all environments and checkouts that hold the
same could share it: here they do.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from llvmlite.binding import get_host_cpu_name
from numba import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.misc.appdirs import AppDirs

from mmsynth.files import write_atomic

_SOURCES = Path(__file__).parent
_VERSIONS = 8  # kept beside each other, 5 MB each: of all environments and checkouts of the user


def version_of_sources(folder: Path) -> str:
    """Of the kernels in a folder, of the numbers that they share with others beside it, and of what compiles them for which processor."""
    digest = hashlib.sha256(f"{numba.__version__} {get_host_cpu_name()}".encode())
    for path in sorted([*folder.glob("*.py"), *folder.parent.glob("*.py")]):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


@functools.cache
def _version() -> str:
    return version_of_sources(_SOURCES)


def kept_in() -> Path:
    """The folder of this version: in numba's own cache folder if one is set, with the user's caches, or where nothing may be written there,
    beside the sources."""
    name = f"kernels-{_version()}"
    if config.CACHE_DIR:
        return Path(config.CACHE_DIR) / name
    with_others = Path(AppDirs("mmsynth").user_cache_dir) / name
    with contextlib.suppress(OSError):
        with_others.mkdir(parents=True, exist_ok=True)
    return with_others if os.access(with_others, os.W_OK) else _SOURCES / "__pycache__" / name


class _ByVersion(_CacheLocator):
    """Of a kernel: wherever its sources lie."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.folder, self.line = kept_in(), function.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        return str(self.folder)

    def get_source_stamp(self) -> str:
        return _version()

    def get_disambiguator(self) -> str:
        return str(self.line)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _ByVersion:
        found = cls(py_func)
        found.ensure_cache_path()
        return found


class _KernelCacheImpl(CompileResultCacheImpl):
    _locator_classes = (_ByVersion,)


class KernelCache(FunctionCache):
    """Numba's, of the code of one function."""

    _impl_class = _KernelCacheImpl


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
