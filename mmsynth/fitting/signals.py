"""Ctrl-C and SIGTERM between the steps of a fit."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def delayed_signals() -> Iterator[list[int]]:
    """Within it, SIGINT and SIGTERM are only noted, in the list that it yields, so that a step is never left half done. A second one acts
    at once. Where no handler can be set (in another thread than the main one) and for signals that are ignored, nothing changes."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    before = {
        number: handler for number in (signal.SIGINT, signal.SIGTERM) if (handler := signal.getsignal(number)) not in (None, signal.SIG_IGN)
    }

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        restore()

    for number in before:
        signal.signal(number, note)
    try:
        yield noted
    finally:
        restore()
