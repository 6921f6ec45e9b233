"""The typer application, and what every command shares with the terminal: errors as one sentence, a progress bar."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from mmsynth.errors import DivergedError, InputError

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Learn one radiance field of a scene from several sensors; then convert, generate, mesh.",
)


def command(name: str, of: typer.Typer = app) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a command whose errors (``mmsynth.errors``) become one sentence on stderr and an exit code."""

    def register(function: Callable[..., None]) -> Callable[..., None]:
        @of.command(name)
        @functools.wraps(function)
        def guarded(*args: Any, **kwargs: Any) -> None:
            try:
                function(*args, **kwargs)
            except (InputError, DivergedError) as error:
                print(f"error: {error}", file=sys.stderr)
                raise typer.Exit(error.exit_code) from None
            except KeyboardInterrupt:
                print("interrupted", file=sys.stderr)
                raise typer.Exit(130) from None

        return guarded

    return register


@contextmanager
def progress_bar(title: str, quiet: bool) -> Iterator[Callable[..., None]]:
    """A progress bar on stderr, for terminals: the yielded function is called with (done, total) and, if any, news to show."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(24),
        TextColumn("{task.percentage:3.0f}%"),
        TimeElapsedColumn(),
        TextColumn("eta"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[news]}"),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, refresh_per_second=4) as progress:
        task = progress.add_task(title, total=None, news="")
        yield lambda done, total, news="": progress.update(task, completed=done, total=total, news=news)


def print_written(destination: Path, written: list[Path], as_json: bool) -> None:
    if as_json:
        print(json.dumps({"out": str(destination), "files": [str(p) for p in written]}))
    else:
        print(f"wrote {len(written)} files into {destination}/")


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="print the version")] = False) -> None:
    if version:
        from mmsynth.version import __version__

        print(__version__)
        raise typer.Exit
