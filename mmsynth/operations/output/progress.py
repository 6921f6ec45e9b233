"""Progress of an operation: one callback for all of them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence

Progress = Callable[[int, int], None]
"""Called as ``progress(done, total)``; the unit (rays, blocks, ...) is the operation's."""
RaysDone = Callable[[int], None]
"""What ``Field.render`` calls with the rays done since the last call; a ``Counter`` makes it of a ``Progress``."""


class Counter:
    """Adds up what is done and reports it to the callback, if there is one. Call it with what was done since the last call."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self.progress, self.total, self.done = progress, total, 0

    def __call__(self, more: int) -> None:
        self.done += more
        if self.progress is not None:
            self.progress(self.done, self.total)


def parts(progress: Progress | None, shares: Sequence[float]) -> Iterator[Progress | None]:
    """One callback for each of several parts of an operation; ``shares``: of its time, their sum is 1."""
    begin, whole = 0.0, 1000

    def part(begin: float, share: float, done: int, total: int) -> None:
        if progress is not None:
            progress(round(whole * (begin + share * done / max(total, 1))), whole)

    for share in shares:
        yield None if progress is None else functools.partial(part, begin, share)
        begin += share
