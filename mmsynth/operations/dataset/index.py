"""Which parts of a dataset are on disk and intact: views, shards, ``dataset.json``."""

from __future__ import annotations

import io
import shutil
import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mmsynth.errors import InputError
from mmsynth.files import read_json, sha256_of, write_atomic, write_json
from mmsynth.scene.images import read_npz

PER_SHARD = 64
_OF_A_SHARD = ("sha256", "bytes")


def view_folder(index: int) -> str:
    return f"views/{index:04d}"


def shard_name(index: int) -> str:
    """Of the shard that holds a view."""
    return f"shards/{index // PER_SHARD:06d}.tar"


def finished_view(out: Path, index: int, key: str) -> dict[str, Any] | None:
    """What ``view.json`` says of a complete view of the same request, or None."""
    stated = _stated(out / view_folder(index) / "view.json")
    good = stated is not None and stated.get("request") == key and not file_problems(out / view_folder(index), stated["files"])
    return stated if good else None


def finished_shard(out: Path, name: str, keys: Sequence[str]) -> list[dict[str, Any]] | None:
    """What the sidecar of a complete shard says of its views, or None."""
    path = out / name
    stated = _stated(path.with_suffix(".json"))
    if stated is None or [view.get("request") for view in stated.get("views", [])] != list(keys):
        return None
    good = not file_problems(path.parent, {path.name: {key: stated[key] for key in _OF_A_SHARD}})
    return list(stated["views"]) if good else None


def _stated(path: Path) -> dict[str, Any] | None:
    try:
        stated = read_json(path)
    except InputError:
        return None
    return stated if isinstance(stated, dict) else None


def pack_shard(out: Path, name: str, indices: Sequence[int]) -> None:
    """Views → one tar file as the webdataset package reads them (``0007.rgb.npz``, ``0007.json``, ...), its sidecar.

    The same views give the same bytes: nothing of the machine or the time is in it.
    """
    path = out / name
    views = [read_json(out / view_folder(index) / "view.json") for index in indices]

    def write(temporary: Path) -> None:
        with tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar:
            for index, stated in zip(indices, views, strict=True):
                for file in sorted(stated["files"]):
                    _add(tar, f"{index:04d}.{file}", (out / view_folder(index) / file).read_bytes())
                _add(tar, f"{index:04d}.json", (out / view_folder(index) / "view.json").read_bytes())

    path.with_suffix(".json").unlink(missing_ok=True)
    write_atomic(path, write)
    write_json(path.with_suffix(".json"), {"sha256": sha256_of(path), "bytes": path.stat().st_size, "views": views})


def drop_views(out: Path, indices: Sequence[int]) -> None:
    """Remove the folders of views that a finished shard holds."""
    for index in indices:
        shutil.rmtree(out / view_folder(index), ignore_errors=True)


def _add(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size, member.mode = len(content), 0o644
    tar.addfile(member, io.BytesIO(content))


def read_dataset(out: Path) -> dict[str, Any]:
    """The content of ``dataset.json``.

    Raises:
        InputError: missing, or not that of a dataset.
    """
    content = read_json(out / "dataset.json")
    if not isinstance(content, dict) or not isinstance(content.get("views"), list):
        raise InputError(f"{out / 'dataset.json'}: key 'views' is missing, expected a dataset made by generate-dataset.")
    return content


def verify_dataset(out: Path | str) -> list[str]:
    """Check a dataset against its ``dataset.json``, without its field or scene: one sentence per problem, empty when all is well.

    Every file is there with the stated size and hash; npz files hold the stated arrays; no array of numbers is infinite.

    Raises:
        InputError: there is no readable ``dataset.json``.
    """
    out = Path(out)
    content = read_dataset(out)
    problems: list[str] = []
    for name, stated in content.get("shards", {}).items():
        problems += file_problems(out, {name: stated})
    for view in content["views"]:
        if "shard" in view:
            continue
        folder = out / view["folder"]
        of_files = file_problems(folder, view["files"])
        problems += of_files
        if not (folder / "view.json").is_file():
            problems.append(f"{folder / 'view.json'}: missing.")
        if not of_files:
            for name, stated in view["files"].items():
                if name.endswith(".npz"):
                    problems += _array_problems(folder / name, stated["arrays"])
    return problems + file_problems(out, content.get("files", {}))


def file_problems(folder: Path, files: Mapping[str, Any]) -> list[str]:
    """What is wrong with files of which bytes and sha256 are stated."""
    problems = []
    for name, stated in files.items():
        path = folder / name
        if not path.is_file():
            problems.append(f"{path}: missing.")
        elif path.stat().st_size != stated["bytes"]:
            problems.append(f"{path}: {path.stat().st_size} bytes, expected {stated['bytes']}.")
        elif sha256_of(path) != stated["sha256"]:
            problems.append(f"{path}: the content does not match its SHA-256 in dataset.json.")
    return problems


def _array_problems(path: Path, stated: Mapping[str, Any]) -> list[str]:
    problems = []
    arrays = read_npz(path)
    for key, facts in stated.items():
        if key not in arrays:
            problems.append(f"{path}: array '{key}' is missing.")
            continue
        array = arrays[key]
        if list(array.shape) != facts["shape"] or str(array.dtype) != facts["dtype"]:
            problems.append(f"{path}: array '{key}' is {array.dtype}{list(array.shape)}, expected {facts['dtype']}{facts['shape']}.")
        elif array.dtype.kind == "f" and np.isinf(array).any():
            problems.append(f"{path}: array '{key}' holds infinite values.")
    return problems
