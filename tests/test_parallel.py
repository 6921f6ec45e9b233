"""Tiles side by side: in their order, each on one thread."""

from __future__ import annotations

import os
import platform
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from mmsynth import parallel
from mmsynth.field.kernels.cpu import stores
from mmsynth.parallel import give_back, side_by_side
from mmsynth.threads import kernel_threads


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(parallel, "kernel_threads", lambda: 3)
    return 3


def test_tiles_come_in_their_order_and_are_made_as_they_are_needed(threads: int) -> None:
    made: list[int] = []

    def numbers() -> Iterator[int]:
        for i in range(100):
            made.append(i)
            yield i

    gate = threading.Event()
    found = side_by_side(lambda i: (gate.wait() if i == 0 else None, i * i)[1], numbers())
    threading.Timer(0.05, gate.set).start()  # the first is the last to be ready
    assert next(found) == (0, 0) and len(made) == parallel._AHEAD * threads
    assert list(found) == [(i, i * i) for i in range(1, 100)]


def test_each_has_a_thread_of_its_own_and_all_others_keep_theirs(threads: int) -> None:
    before = torch.get_num_threads(), kernel_threads()
    meet = threading.Barrier(threads)  # no thread takes two tiles

    def look(_: int) -> tuple[int, int, int]:
        meet.wait(10)
        return threading.get_ident(), torch.get_num_threads(), kernel_threads()

    seen = [found for _, found in side_by_side(look, range(threads))]
    assert len({who for who, _, _ in seen}) == threads and {(of_torch, of_kernels) for _, of_torch, of_kernels in seen} == {(1, 1)}
    assert (torch.get_num_threads(), kernel_threads()) == before
    later: list[int] = []
    thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert later == [before[0]]


def test_fewer_tiles_than_threads_have_all_of_them_one_after_the_other(threads: int) -> None:
    here = threading.get_ident()
    assert [found for _, found in side_by_side(lambda _: threading.get_ident(), range(threads - 1))] == [here] * (threads - 1)
    assert list(side_by_side(lambda tile: tile, [])) == []


def test_one_that_fails_ends_it_and_what_has_not_begun_is_not_worked_on(threads: int) -> None:
    done: list[int] = []

    def work(i: int) -> None:
        done.append(i)
        if i == 2:
            raise ValueError("tile 2")

    with pytest.raises(ValueError, match="tile 2"):
        list(side_by_side(work, range(1000)))
    assert len(done) <= 3 + parallel._AHEAD * threads
    found = side_by_side(lambda i: i, range(1000))
    assert next(found) == (0, 0)
    found.close()  # no more are wanted
    assert list(side_by_side(lambda i: i + 1, range(5))) == [(i, i + 1) for i in range(5)]


def test_arrays_that_several_threads_ask_for_have_one_owner_each(threads: int) -> None:
    """What is kept for the next to ask was looked for and taken in two steps: another could take it between them."""
    kinds = [stores.surface_store, lambda *of: stores.ray_store(*of, 2)]
    switch = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)

    def ask(i: int) -> int:
        wrong = 0
        for j in range(200):
            store = kinds[(i + j) % 2](1, 8 * (1 + (i + j) % 3), 2)
            wrong += store.arrays._fields != (stores.SurfaceStore if (i + j) % 2 == 0 else stores.RayStore)._fields
            store.arrays[0].flat[0] = i
            sum(range(20))
            wrong += store.arrays[0].flat[0] != i
        return wrong

    try:
        assert sum(wrong for _, wrong in side_by_side(ask, range(12))) == 0
    finally:
        sys.setswitchinterval(switch)


@pytest.mark.skipif(sys.platform != "linux" or platform.libc_ver()[0] != "glibc", reason="glibc alone keeps what was freed")
def test_what_threads_have_freed_is_given_back(use_threads: Callable[[int], None]) -> None:
    use_threads(2)
    resident = lambda: int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6

    def kept(_: int) -> np.ndarray:
        """The last of many blocks, behind which those before it are not at the end of what a thread has."""
        return [np.ones(8000) for _ in range(500)][-1]  # 32 MB

    last = [block for _, block in side_by_side(kept, range(8))]
    before = resident()
    give_back()
    assert resident() < before - 20 and all(block.all() for block in last)
