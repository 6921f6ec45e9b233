"""TOML files read into pydantic models: recipes, tables of variants, sensors."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from mmsynth.errors import InputError

Model = TypeVar("Model", bound=BaseModel)


def read_toml(path: Path, model: type[Model]) -> Model:
    """Read a TOML file.

    Raises:
        InputError: unreadable file, broken TOML, an unknown key, or a value that cannot be; in one sentence, with the key.
    """
    try:
        return model.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise InputError(f"{path}: could not be read ({error.strerror}).") from error
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error)}.") from error
    except (ValueError, RecursionError) as error:  # broken TOML, no UTF-8, a number of thousands of digits, lists in lists without end
        raise InputError(f"{path}: not valid TOML ({error}).") from error


def first_problem(error: ValidationError) -> str:
    """The first thing that is wrong, with its key and without a full stop."""
    first = error.errors()[0]
    where = ".".join(map(str, first["loc"]))
    said = first["msg"].removeprefix("Value error, ").rstrip(".")
    # what a part says of itself begins with its name
    return said if not where or said.startswith(f"{where}: ") else f"{where}: {said}"
