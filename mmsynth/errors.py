"""The two ways a command may refuse: the input is wrong, or the disk is."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input. The message is ONE sentence: which file, which key or pixel, what was expected.

    The command line prints it and exits with code 2; nothing is half-written.
    """
