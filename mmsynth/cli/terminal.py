"""The typer application, and what every command shares with the terminal: errors as one sentence, a progress bar."""

from __future__ import annotations

import functools
import json
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from mmsynth.errors import Interrupted, known_error

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
                with _signals_interrupt():
                    function(*args, **kwargs)
            except KeyboardInterrupt as stop:
                stop = stop if isinstance(stop, Interrupted) else Interrupted("interrupted")
                print(stop, file=sys.stderr)
                raise typer.Exit(stop.exit_code) from None
            except Exception as error:
                known = known_error(error, name)
                if known is None:
                    raise
                print(f"error: {known}", file=sys.stderr)
                raise typer.Exit(known.exit_code) from None

        return guarded

    return register


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """SIGTERM (of ``kill``, a batch system, ``docker stop``) ends a command as Ctrl-C does: what is not finished is cleared away.

    Neither is lost where it arrives while an object is destroyed: what is raised there Python tells and ignores, so it is sent again.
    """

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Interrupted("terminated", number)

    def unraisable(ignored: sys.UnraisableHookArgs) -> None:
        if not issubclass(ignored.exc_type, KeyboardInterrupt):
            tell(ignored)
            return
        number = signal.SIGTERM if issubclass(ignored.exc_type, Interrupted) else signal.SIGINT
        # not at once: this function is called where nothing can be raised, either
        again = threading.Timer(0.01, signal.pthread_kill, (threading.main_thread().ident, number))
        again.daemon = True
        again.start()

    before, tell = signal.signal(signal.SIGTERM, interrupt), sys.unraisablehook
    sys.unraisablehook = unraisable
    try:
        yield
    finally:
        sys.unraisablehook = tell
        signal.signal(signal.SIGTERM, before)


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
