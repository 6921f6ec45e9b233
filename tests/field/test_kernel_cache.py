"""Compiled code that belongs to other sources is never used."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest

from mmsynth.field.kernels.cpu import KERNELS, caching

SOURCES = Path(caching.__file__).parent


def _folder(path: Path) -> Path:
    (path / "kernels").mkdir(parents=True)
    (path / "numbers.py").write_text("ONE = 1\n")
    (path / "kernels" / "blocks.py").write_text("def inner(x):\n    return x + 1\n")
    (path / "kernels" / "surface.py").write_text("from blocks import inner\n")
    return path / "kernels"


@pytest.mark.parametrize("changed", ["kernels/blocks.py", "kernels/new.py", "numbers.py"])
def test_a_change_of_any_source_is_another_version(tmp_path: Path, changed: str) -> None:
    folder = _folder(tmp_path)
    before = caching.version_of_sources(folder)
    assert caching.version_of_sources(_folder(tmp_path / "copy")) == before
    (tmp_path / changed).write_text("def inner(x):\n    return x + 2\n")
    assert caching.version_of_sources(folder) != before


def test_each_version_has_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"kernels-{caching.version_of_sources(SOURCES)}"
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "mine"))
    assert caching.kept_in() == tmp_path / "mine" / name
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(caching, "AppDirs", lambda _: SimpleNamespace(user_cache_dir=str(tmp_path / "user")))
    assert caching.kept_in() == tmp_path / "user" / name and caching.kept_in().is_dir()
    monkeypatch.setattr(caching.os, "access", lambda *_: False)
    assert caching.kept_in() == SOURCES / "__pycache__" / name
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(caching, "AppDirs", lambda _: SimpleNamespace(user_cache_dir=str(tmp_path / "file")))
    assert caching.kept_in() == SOURCES / "__pycache__" / name


@pytest.mark.parametrize("other", ["numba", "processor"])
def test_another_compiler_or_processor_is_another_version(other: str, monkeypatch: pytest.MonkeyPatch) -> None:
    before = caching.version_of_sources(SOURCES)
    if other == "numba":
        monkeypatch.setattr(caching.numba, "__version__", "0.0")
    else:
        monkeypatch.setattr(caching, "get_host_cpu_name", lambda: "8086")
    assert caching.version_of_sources(SOURCES) != before


def test_checkouts_that_hold_the_same_share_what_one_has_compiled(tmp_path: Path) -> None:
    """A kernel in two folders: numba's own cache keeps them apart."""

    def result(folder: str) -> list[str]:
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "program.py").write_text(
            "from mmsynth.field.kernels.cpu.jit import kernel\n"
            "@kernel\ndef outer(x): return x + 1\n"
            "print(outer(1), sum(outer.stats.cache_hits.values()))\n"
        )
        variables = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
        run = subprocess.run(
            [sys.executable, str(tmp_path / folder / "program.py")], env=variables, capture_output=True, text=True, check=True
        )
        return run.stdout.split()

    assert result("one") == ["2", "0"] and result("other") == ["2", "1"]


def test_the_last_versions_are_kept(tmp_path: Path) -> None:
    names = [f"kernels-{i}" for i in range(10)]
    for age, name in enumerate((*names, "other")):
        (tmp_path / name / "cpu").mkdir(parents=True)
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    caching.remove_old_versions(tmp_path / "kernels-9")
    assert {path.name for path in tmp_path.iterdir()} == {*names[:7], "kernels-9", "other"}


def test_the_kernels_are_kept_by_version() -> None:
    assert all(Path(kernel._cache._cache_path) == caching.kept_in() for kernel in KERNELS)


def test_what_was_compiled_apart_is_put_where_it_is_looked_for(tmp_path: Path) -> None:
    """A program that numba compiles with a cache of its own; another one finds its code, and no other function's."""
    (tmp_path / "program.py").write_text(
        "import sys; from pathlib import Path; from numba import njit\n"
        "@njit(cache=True)\ndef inner(x): return x + 1\n"
        "@njit(cache=True)\ndef outer(x): return inner(x) + 1\n"
        "print(outer(1), sum(outer.stats.cache_hits.values()), outer._cache._cache_path, Path(outer._cache._cache_file._index_name).stem)\n"
    )

    def result(cache: str) -> list[str]:
        variables = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / cache)}
        run = subprocess.run([sys.executable, str(tmp_path / "program.py")], env=variables, capture_output=True, text=True, check=True)
        return run.stdout.split()

    *told, made, name = result("own")
    assert told == ["3", "0"]
    kept = tmp_path / "kept" / Path(made).name
    caching.publish(Path(made), kept, name)
    caching.publish(Path(made), kept, "nothing")
    assert {path.name for path in kept.iterdir()} == {f"{name}.nbi", f"{name}.1.nbc"}
    assert result("kept")[:2] == ["3", "1"]
