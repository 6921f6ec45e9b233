"""Threads of numba follow those of torch."""

import os
import subprocess
import sys

import pytest

from mmsynth.threads import let_numba_follow, usable_cores

CORES = usable_cores()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, None),
        ({"OMP_NUM_THREADS": "1"}, "1"),
        ({"OMP_NUM_THREADS": str(CORES + 7)}, str(CORES)),
        ({"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "2"}, "2"),
        ({"OMP_NUM_THREADS": "4,2"}, None),  # of nested regions: OpenMP knows what it means
        ({"OMP_NUM_THREADS": "0"}, None),  # OpenMP ignores it, numba would refuse it
        ({"OMP_NUM_THREADS": ""}, None),
    ],
)
def test_numba_takes_what_torch_takes_unless_it_is_told_itself(given: dict[str, str], expected: str | None) -> None:
    environment = dict(given)
    let_numba_follow(environment)
    assert environment.get("NUMBA_NUM_THREADS") == expected


def test_a_command_has_as_many_threads_of_either_as_it_is_given() -> None:
    program = (
        "import sys; from mmsynth import cli; sys.argv = ['mmsynth', '--version']\n"
        "try: cli.main()\n"
        "except SystemExit: pass\n"
        "import torch, numba; print(torch.get_num_threads(), numba.get_num_threads())"
    )
    variables = {name: value for name, value in os.environ.items() if name != "NUMBA_NUM_THREADS"} | {"OMP_NUM_THREADS": "1"}
    run = subprocess.run([sys.executable, "-c", program], env=variables, capture_output=True, text=True)
    assert run.stdout.splitlines()[-1] == "1 1", run.stderr
