"""What a process of our own sets before it imports torch; a library leaves both to the program that it is in."""

import gc
import os


def set_up() -> None:
    """Short spins at barriers, and garbage looked for a fourteenth as often as by default."""
    # OpenMP's threads spin for milliseconds at every barrier by default, which stalls a fit beside another busy process. A short spin
    # costs nothing alone and was 1.6 times as fast beside one. Read when torch is loaded; a user's own setting stays.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    # importing torch and numba makes half a million objects that stay: to look through them over and over was a tenth of a command's start
    gc.set_threshold(10_000, 10, 10)
