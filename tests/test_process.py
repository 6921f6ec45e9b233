"""What processes of our own set up, and frames of deep calls."""

import resource
import sys

import pytest

from mmsynth.process import with_frames_in_one_block


def _faults_of_calls(depth: int) -> int:
    """New pages that a thousand calls from this depth ask of the system."""
    if depth:
        return _faults_of_calls(depth - 1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(1000):
        _nothing()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def _nothing(a: int = 1, b: int = 2) -> int:
    return a + b


@pytest.mark.skipif(sys.implementation.name != "cpython", reason="of CPython's frames")
def test_no_depth_asks_for_pages_at_each_call() -> None:
    found: list[int] = []
    with_frames_in_one_block(lambda: found.extend(map(_faults_of_calls, range(250))))
    assert len(found) == 250 and max(found) < 100


def test_what_is_raised_within_is_raised() -> None:
    def fail() -> None:
        raise ValueError("within")

    with pytest.raises(ValueError, match="within"):
        with_frames_in_one_block(fail)
