"""The ways a command ends without its result.

=================== =========
what happened       exit code
=================== =========
a fit diverged      1
input or a disk     2
out of memory       3
Ctrl-C              130
SIGTERM             143
=================== =========

The message of each is ONE sentence. The command line prints it and exits with ``exit_code``; nothing is half-written.
"""

from __future__ import annotations

import signal


class InputError(ValueError):
    """Bad input, or a file that cannot be read or written: which file, which key or pixel, what was expected."""

    exit_code = 2


class DivergedError(ArithmeticError):
    """A fit whose loss or gradients stopped to be finite: at which step, and what is kept."""

    exit_code = 1


class OutOfMemoryError(MemoryError):
    """There is not enough memory, of the machine or the GPU: for what, and what is kept."""

    exit_code = 3


class Interrupted(KeyboardInterrupt):
    """A signal asked to stop: what is kept."""

    def __init__(self, message: str, number: int = signal.SIGINT) -> None:
        super().__init__(message)
        self.exit_code = 128 + number


KnownError = InputError | DivergedError | OutOfMemoryError

# as numpy, torch, CUDA, OpenCV, the C++ library and the dynamic loader say it
_NO_MEMORY = ("out of memory", "not enough memory", "allocate memory", "insufficient memory", "failed to allocate", "bad_alloc")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory is what lacked; each library says so in its own way."""
    return isinstance(error, MemoryError) or any(text in str(error).lower() for text in _NO_MEMORY)


def known_error(error: Exception, doing: str) -> KnownError | None:
    """The error as one that ends a command with a sentence: itself, or for one of a library that says that memory lacked or that the
    operating system refused (a disk that is full, a file that was removed) that; None for any other, which is a defect.

    Args:
        doing: which command, for an error that does not say on what.
    """
    if isinstance(error, KnownError):
        return error
    if is_out_of_memory(error):
        said = str(error).strip().partition("\n")[0].split("DefaultCPUAllocator: ")[-1].rstrip(".")
        return OutOfMemoryError(f"{doing}: out of memory ({said})." if said else f"{doing}: out of memory.")
    if isinstance(error, OSError) and error.errno is not None and not isinstance(error, BrokenPipeError):
        return InputError(f"{error.filename or doing}: {error.strerror}.")
    return None
