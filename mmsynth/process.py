"""What processes of our own do for the interpreter they run in; a library leaves that to the program that it is in."""

import gc
import os
from collections.abc import Callable


def set_up() -> None:
    """Before torch is imported: short spins at barriers, and garbage looked for a fourteenth as often as by default."""
    # OpenMP's threads spin for milliseconds at every barrier by default, which stalls a fit beside another busy process. A short spin
    # costs nothing alone and was 1.6 times as fast beside one. Read when torch is loaded; a user's own setting stays.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    # importing torch and numba makes half a million objects that stay: to look through them over and over was a tenth of a command's start
    gc.set_threshold(10_000, 10, 10)


def with_frames_in_one_block(call: Callable[[], None]) -> None:
    """Call what calls many thousand small functions from deep within others, as a compiler in Python does.

    CPython keeps the frames of calls in blocks of 16 kB. A loop that happens to call across the end of one asks the system for the next
    block at each call, and gives it back at each return: compiling kernels did so a million times, an eighth of its time. A frame that
    needs 1 MB gets a block of twice its size, and the calls within it share the rest.
    """

    def large() -> None:
        call()

    large.__code__ = large.__code__.replace(co_stacksize=1 << 17)
    large()
