"""The machine's name and limits."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from mmsynth.bench import machine
from mmsynth.errors import InputError
from mmsynth.threads import kernel_threads

ROOT = Path(__file__).parents[2]


def test_a_machine_has_a_name_and_positive_limits() -> None:
    found = machine.measure()
    json.dumps(found, allow_nan=False)
    assert found["cores"] >= 1 and found["threads"] >= 1 and found["flags"] and found["memory_gb"] > 0
    assert set(found["versions"]) == {"mmsynth", "python", "torch", "numba", "numpy"}
    for key in ("bandwidth_gb_s", "bandwidth_one_thread_gb_s", "gemm_gflops"):
        assert found[key] > 0
    line = machine.describe(found)
    assert found["cpu"] in line and torch.__version__ in line and "\n" not in line


def test_threads_are_given_back() -> None:
    before = torch.get_num_threads(), kernel_threads()
    with machine.use_threads(1):
        assert (torch.get_num_threads(), kernel_threads()) == (1, 1)
    assert (torch.get_num_threads(), kernel_threads()) == before
    with pytest.raises(InputError, match="--threads 99999"), machine.use_threads(99999):
        pass
    assert (torch.get_num_threads(), kernel_threads()) == before


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="needs Linux's /proc")
def test_peak_memory_is_the_process_own() -> None:
    """A child of a large process is not large itself, and a peak stays when the memory is given back.

    Both told by the child, by hundreds of MB: Linux counts pages per core in batches, so what it tells of a peak may fall by some of them.
    """
    large = np.ones(300_000_000, np.uint8)
    mine = machine.peak_memory()
    assert mine > large.nbytes
    code = "import numpy; from mmsynth.bench.machine import peak_memory as p; one = p(); a = numpy.ones(50_000_000); del a; print(one, p())"
    said = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=True
    )
    before, after = map(int, said.stdout.split())
    assert before < mine - large.nbytes / 2
    assert max(400_000_000, before + 300_000_000) < after < before + 420_000_000
