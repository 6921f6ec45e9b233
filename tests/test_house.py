"""The house: rooms import from rooms above them alone, and no modules import each other in a circle.

Every import counts, also one within a function or under TYPE_CHECKING.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import mmsynth

# from the top down; modules of one room may import each other
ROOMS = """
    errors version packaged files toml process threads parallel
    sensors scene prior field.kernels field fitting
    operations.output operations.views operations.conversion operations.simulation operations.dataset operations.mesh operations.evaluation
    operations.export
    report viewer workflows bench cli
""".split()

ROOT = Path(mmsynth.__file__).parent


def _name(path: Path) -> str:
    """``field/kernels/__init__.py`` → ``field.kernels``"""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix("__init__").rstrip(".")


MODULES = {_name(path): path for path in sorted(ROOT.rglob("*.py")) if "_data" not in path.parts}


def _imports(module: str) -> Iterator[str]:
    """The modules of the package that a module imports, "" for the package itself."""
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import in line {node.lineno}"
            # `from package import module` imports the module
            names = [n if _within(n := f"{node.module}.{alias.name}") in MODULES else str(node.module) for alias in node.names]
        else:
            continue
        yield from (_within(name) for name in names if name.split(".")[0] == "mmsynth")


def _within(name: str) -> str:
    return name.removeprefix("mmsynth").lstrip(".")


def _room(module: str) -> int:
    """The place in the order of the innermost room that holds a module."""
    holds = [i for i, room in enumerate(ROOMS) if module == room or module.startswith(f"{room}.")]
    assert holds, f"mmsynth.{module} lies in no room: {', '.join(ROOMS)}"
    return max(holds, key=lambda i: len(ROOMS[i]))


# the face of the package names what users import, and imports it when it is asked for; a folder of folders holds nothing itself
INSIDE = [module for module in MODULES if module not in ("", "__main__", "operations")]


@pytest.mark.parametrize("module", INSIDE)
def test_a_room_imports_from_rooms_above_it(module: str) -> None:
    for used in _imports(module):
        assert used in INSIDE, f"mmsynth.{module} imports mmsynth.{used}, which is not inside the house"
        assert _room(used) <= _room(module), f"mmsynth.{module} imports mmsynth.{used}, of a room below its own"


def test_no_modules_import_each_other_in_a_circle() -> None:
    try:
        TopologicalSorter({module: set(_imports(module)) - {module} for module in INSIDE}).prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' -> '.join(error.args[1])}")


@pytest.mark.parametrize("module", MODULES)
def test_a_long_file_says_why(module: str) -> None:
    source = MODULES[module].read_text()
    if source.count("\n") > 400:
        assert "in one file" in (ast.get_docstring(ast.parse(source)) or ""), (
            f"mmsynth.{module}: over 400 lines, and no reason in its docstring"
        )


@pytest.mark.parametrize("folder", [m for m, path in MODULES.items() if path.name == "__init__.py"])
def test_a_folder_says_what_lives_there(folder: str) -> None:
    assert ast.get_docstring(ast.parse(MODULES[folder].read_text()))
