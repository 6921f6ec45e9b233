"""What a process that runs tests sets before it imports numpy and torch; ``conftest.py`` imports it first."""

import gc
import os

if "PYTEST_XDIST_WORKER" in os.environ:
    # two threads a process on two cores wait for each other at every barrier; of commands that tests start, too
    os.environ["OMP_NUM_THREADS"] = "1"
# a million objects of torch, numba and the tests stay to the end: to look through them for garbage was a twentieth of the tests' time
gc.set_threshold(50_000, 20, 20)
