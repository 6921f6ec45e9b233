"""Compiled code that belongs to other sources is never used."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from mmsynth.field.kernels.cpu import KERNELS, caching


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


def test_each_version_has_its_folder_and_other_code_keeps_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = _folder(tmp_path)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    with caching.kept_by_version(folder):
        beside = Path(numba.config.CACHE_DIR)
    assert beside == folder / "__pycache__" / f"kernels-{caching.version_of_sources(folder)}"
    assert numba.config.CACHE_DIR == ""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "mine"))
    with caching.kept_by_version(folder):
        assert Path(numba.config.CACHE_DIR).parent == tmp_path / "mine"
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(caching.os, "access", lambda *_: False)
    with caching.kept_by_version(folder):
        assert tmp_path not in Path(numba.config.CACHE_DIR).parents and "mmsynth" in numba.config.CACHE_DIR


def test_the_last_versions_are_kept(tmp_path: Path) -> None:
    for age, name in enumerate(("kernels-now", "kernels-a", "kernels-b", "kernels-c", "other")):
        (tmp_path / name / "cpu").mkdir(parents=True)
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    caching.remove_old_versions(tmp_path / "kernels-now")
    assert {path.name for path in tmp_path.iterdir()} == {"kernels-now", "kernels-a", "kernels-b", "other"}


def test_the_kernels_are_kept_by_version() -> None:
    version = caching.version_of_sources(Path(caching.__file__).parent)
    assert all(Path(kernel._cache._cache_path).parent.name == f"kernels-{version}" for kernel in KERNELS)


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
