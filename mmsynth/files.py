"""Atomic file output: everything is written to a temporary neighbour, flushed, then renamed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mmsynth.errors import InputError


def write_atomic(path: Path, write: Callable[[Path], Any]) -> None:
    """Call ``write(temporary_path)`` and rename the result to ``path``.

    The temporary file keeps the suffix of ``path`` (many writers choose the format by it) and lives in the same
    folder, so that the rename is atomic. Whatever goes wrong, no part of the file is left behind.

    Raises:
        InputError: the disk is full, the folder is not writable, or the writer refused.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        # pages reach the disk before the name does; a writer's own error report (a full disk) surfaces here at the latest
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as error:
        reason = error.strerror or str(error).replace(str(temporary), path.name)
        raise InputError(f"{path}: could not be written ({reason}).") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that writers left in a folder when they were killed. Nobody else may be writing there."""
    for left in folder.glob(".*.[0-9]*.tmp*"):
        left.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8, atomically."""
    write_atomic(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically. NaN is refused: JSON has none."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_text(path: Path) -> str:
    """Read a UTF-8 file; InputError where it is missing, unreadable or something else."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text at byte {error.start}.") from error
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror or error}).") from error


def read_json(path: Path) -> Any:
    """Read a JSON file; InputError as ``read_text``, or where it is not JSON (with line and column)."""
    text = read_text(path)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: not valid JSON at line {error.lineno}, column {error.colno} ({error.msg}).") from error
    except (ValueError, RecursionError) as error:  # a number of thousands of digits, lists in lists without end
        raise InputError(f"{path}: JSON that cannot be read ({str(error).split(';')[0].split(': ')[0]}).") from error


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
