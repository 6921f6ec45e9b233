"""The two ways a command ends without its result: the input is wrong (or cannot be read or written), or a fit diverged.

The message of each is ONE sentence. The command line prints it and exits with ``exit_code``; nothing is half-written.
"""

from __future__ import annotations


class InputError(ValueError):
    """Bad input, or a file that cannot be read or written: which file, which key or pixel, what was expected."""

    exit_code = 2


class DivergedError(ArithmeticError):
    """A fit whose loss or gradients stopped to be finite: at which step, and what is kept."""

    exit_code = 1
