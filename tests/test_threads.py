"""Threads of kernels follow those of torch."""

import os
import subprocess
import sys
import threading

import pytest

from mmsynth import threads
from mmsynth.threads import kernel_threads, let_kernels_have, usable_cores

CORES = usable_cores()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (None, CORES),
        ("1", 1),
        (str(CORES + 7), CORES),
        ("1,2", 1),  # the second is of nested regions
        (" 1 ", 1),
        ("0", CORES),  # OpenMP ignores it
        ("", CORES),
        ("many", CORES),
    ],
)
def test_kernels_take_what_torch_takes_as_far_as_there_are_cores(given: str | None, expected: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    assert threads._of_process.__wrapped__() == expected


def test_a_thread_may_set_its_own_number() -> None:
    before, seen = kernel_threads(), []

    def look() -> None:
        seen.append(kernel_threads())
        let_kernels_have(7)
        seen.append(kernel_threads())

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert seen[1] == 7 and kernel_threads() == before


def test_a_command_has_as_many_threads_of_either_as_it_is_given() -> None:
    program = (
        "import sys; from mmsynth import cli; sys.argv = ['mmsynth', '--version']\n"
        "try: cli.main()\n"
        "except SystemExit: pass\n"
        "import torch; from mmsynth.threads import kernel_threads; print(torch.get_num_threads(), kernel_threads())"
    )
    run = subprocess.run([sys.executable, "-c", program], env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
    assert run.stdout.splitlines()[-1] == "1 1", run.stderr
