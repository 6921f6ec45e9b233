"""Progress of an operation: one callback for all of them."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called as ``progress(done, total)``; the unit (rays, blocks, ...) is the operation's."""


class Counter:
    """Adds up what is done and tells the callback, if there is one. Call it with what was done since the last call."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self.progress, self.total, self.done = progress, total, 0

    def __call__(self, more: int) -> None:
        self.done += more
        if self.progress is not None:
            self.progress(self.done, self.total)
