"""What the documentation names exists: links, headings, commands, options, recipes, sensors, files; and its Python works."""

from __future__ import annotations

import ast
import inspect
import itertools
import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

import mmsynth
from mmsynth.cli import app
from mmsynth.fitting.recipe import load_recipe
from mmsynth.operations.mesh.extract import MeshOptions
from mmsynth.packaged import data_folder
from mmsynth.sensors.sensor_file import find_sensor_file, load_sensor

ROOT = Path(__file__).parents[1]
README, EXAMPLES, HOUSE = ROOT / "README.md", ROOT / "examples/README.md", ROOT / "mmsynth/README.md"
BLOCK = re.compile(r"(?:<!-- (\w+) -->\n)?```(\w*)\n(.*?)```", re.DOTALL)
INLINE = re.compile(r"`([^`\n]+)`")
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def documents() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True)
    return [ROOT / line for line in listed.stdout.splitlines()]


def prose(text: str) -> str:
    """Without blocks of code and comments."""
    return re.sub(r"<!--.*?-->", "", BLOCK.sub("", text), flags=re.DOTALL)


def anchors(path: Path) -> set[str]:
    """As GitHub makes them of headings: lower case, hyphens for spaces, no punctuation, -1, -2, ... for the same heading again."""
    found: set[str] = set()
    for heading in re.findall(r"^#{1,6} (.*)$", prose(path.read_text(encoding="utf-8")), re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        again = sum(slug == re.sub(r"-\d+$", "", other) for other in found)
        found.add(f"{slug}-{again}" if again else slug)
    return found


def command_lines(path: Path) -> Iterator[list[str]]:
    """Every ``mmsynth ...`` of a document, as words after ``mmsynth``: in lines of blocks of code and in code within lines."""
    text = path.read_text(encoding="utf-8")
    lines = [line for _, language, block in BLOCK.findall(text) if language in ("bash", "text") for line in block.splitlines()]
    for line in [*lines, *INLINE.findall(prose(text))]:
        for part in re.split(r"&&|\|", line.removeprefix("$ ")):
            words = shlex.split(part, comments=True) if "mmsynth" in part and "'" not in part else part.split()
            if "mmsynth" in words and (words[0] == "mmsynth" or "torchrun" in words):
                yield words[words.index("mmsynth") + 1 :]


def options_of(words: list[str]) -> set[str]:
    """What a command of these words takes; asserts that there is such a command."""
    group, name = COMMANDS, words[0]
    if name == "bench" and len(words) > 1:
        group, name = COMMANDS["bench"].commands, words[1]
    assert name in group, f"mmsynth {' '.join(words)}: no such command"
    return {option for parameter in group[name].params for option in parameter.opts}


@pytest.mark.parametrize("path", documents(), ids=lambda path: str(path.relative_to(ROOT)))
def test_links_and_headings(path: Path) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", INLINE.sub("code", prose(path.read_text(encoding="utf-8")))):
        file, _, anchor = target.partition("#")
        if re.match(r"https?://", target):
            continue
        there = (path.parent / file).resolve() if file else path
        if not there.exists() or (anchor and anchor not in anchors(there)):
            broken.append(target)
    assert not broken


@pytest.mark.parametrize("path", [README, EXAMPLES, HOUSE], ids=["README", "examples", "mmsynth"])
def test_commands_and_options(path: Path) -> None:
    lines = [words for words in command_lines(path) if words and not words[0].isupper() and words[0] != "--version"]
    for words in lines:
        used = {re.split("=", word)[0] for word in words if word.startswith("--")}
        assert used <= {*options_of(words), "--help"}, f"mmsynth {' '.join(words)}"
    every = {option for name in COMMANDS if name != "bench" for option in options_of([name])}
    alone = {text.split()[0] for text in INLINE.findall(prose(path.read_text(encoding="utf-8"))) if text.startswith("-")}
    assert alone <= {*every, *options_of(["bench", "ablation"])}


def test_every_command_stands_in_the_table() -> None:
    table = re.findall(r"^\| `mmsynth ([\w-]+)", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(table) == sorted(COMMANDS)
    benchmarks = re.findall(r"^\| `mmsynth bench ([\w-]+)", EXAMPLES.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(benchmarks) == sorted(COMMANDS["bench"].commands)


@pytest.mark.parametrize("path", [README, EXAMPLES, HOUSE], ids=["README", "examples", "mmsynth"])
def test_packaged_recipes_and_sensors(path: Path) -> None:
    for words in command_lines(path):
        for option, value in itertools.pairwise(words):
            if option == "--recipe" and value.islower() and not Path(value).suffix:
                load_recipe(value)
            if option == "--sensor" and not Path(value).suffix:
                load_sensor(find_sensor_file(value))


def test_files_that_the_house_names() -> None:
    names = {
        name for name in INLINE.findall(prose(HOUSE.read_text(encoding="utf-8"))) if re.fullmatch(r"[a-z_]+(/[a-z_.]+)+|\w+\.py", name)
    }
    assert len(names) > 20
    assert [name for name in sorted(names) if not any((folder / name).exists() for folder in (HOUSE.parent, ROOT))] == []


def test_set_up_blocks_as_ci_reads_them() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 145
    marked = [(mark, language, block) for mark, language, block in BLOCK.findall(text) if mark]
    assert [mark for mark, _, _ in marked] == ["example", "tests"]
    for _, language, block in marked:
        assert language == "bash" and block.count("\n") == 1 and block.startswith("python3 -m venv .venv && ")
    assert (ROOT / ".ci/constraints.txt").is_file()


def python_blocks() -> list[tuple[str, str, str]]:
    return [
        (f"{path.relative_to(ROOT)}:{index}", mark, block)
        for path in documents()
        for index, (mark, language, block) in enumerate(BLOCK.findall(path.read_text(encoding="utf-8")))
        if language == "python"
    ]


def calls(block: str) -> Iterator[tuple[str, ast.Call]]:
    """Calls of public names, as mmsynth.NAME(...) or imported from mmsynth."""
    tree = ast.parse(block)
    imported = {a.name for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module == "mmsynth" for a in n.names}
    for call in (n for n in ast.walk(tree) if isinstance(n, ast.Call)):
        match call.func:
            case ast.Attribute(value=ast.Name(id="mmsynth"), attr=name):
                yield name, call
            case ast.Name(id=name) if name in imported:
                yield name, call


@pytest.mark.parametrize(("name", "mark", "block"), python_blocks(), ids=[name for name, _, _ in python_blocks()])
def test_python_blocks(name: str, mark: str, block: str) -> None:
    code = compile(block, name, "exec")
    for called, call in calls(block):
        assert called in mmsynth.__all__
        inspect.signature(getattr(mmsynth, called)).bind(*call.args, **{str(k.arg): k.value for k in call.keywords})
    if mark == "runs":
        exec(code, {})


@pytest.mark.usefixtures("decided_by_few_rays")
def test_ten_lines_of_the_readme(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As printed, but for the scene, and lengths and sizes that a test can wait for."""
    (block,) = [block for name, _, block in python_blocks() if name.startswith("README.md")]
    for printed, tested in (
        ('"scene/"', repr(str(data_folder("example_scene")))),
        ("budget=60", "steps=30"),
        ("extract_mesh(field, ", "extract_mesh(field, MeshOptions(resolution=24), "),
    ):
        assert printed in block
        block = block.replace(printed, tested)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "poses.json").write_text('{"trajectory": "orbit", "views": 2}')
    made: dict[str, Any] = {"MeshOptions": MeshOptions}
    exec(compile(block, "README.md", "exec"), made)
    for written in ("runs/latest/report.html", "converted/ms/0009.npz", "dataset/dataset.json", "mesh.ply"):
        assert (tmp_path / written).is_file()
    camera = made["frame"].camera
    assert made["seen"].channels["ms"].shape == (camera.height, camera.width, 9)
