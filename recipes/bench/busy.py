"""A fit beside busy processes: python recipes/bench/busy.py compare [--repeats 3].

Fits of the example scene, of equal steps, alone and beside one and two processes that keep a core each busy, in turns. Of n threads on c
cores beside b such processes a scheduler that is fair to threads gives the fit c / (n + b) of what it has alone: what it loses beyond that
are its threads waiting for each other. The figures are medians; settings of the threads come from the environment.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from mmsynth.threads import usable_cores

_BEGIN = 60  # steps before the clock starts: of a surface that has a shape
app = typer.Typer(add_completion=False)


@app.command()
def compare(
    steps: Annotated[int, typer.Option(min=1, help="that are timed, of each fit")] = 200,
    repeats: Annotated[int, typer.Option(min=1)] = 3,
    most: Annotated[int, typer.Option(min=1, help="busy processes")] = 2,
) -> None:
    """Alone, and beside 1 to ``most`` busy processes."""
    found: dict[int, list[dict[str, float]]] = defaultdict(list)
    for _ in range(repeats):
        for count in range(most + 1):
            with _busy(count):
                command = [sys.executable, __file__, "one", str(steps)]
                done = subprocess.run(command, env={"GOMP_SPINCOUNT": "1000", **os.environ}, capture_output=True, text=True)
            if done.returncode:
                sys.exit(done.stderr)
            found[count].append(json.loads(done.stdout))
    cores, threads = usable_cores(), round(found[0][0]["threads"])
    median = lambda count, key: statistics.median(result[key] for result in found[count])
    print(f"{cores} cores, {threads} threads; {repeats} fits each of {steps} steps")
    print("busy  steps/s  (all)                CPU s/step  of alone: steps/s   fair   CPU")
    for count in sorted(found):
        speed, cpu = median(count, "steps_per_s"), median(count, "cpu_share")
        fair = min(1.0, cores / (threads + count)) / min(1.0, cores / threads)
        every = " ".join(f"{result['steps_per_s']:.1f}" for result in found[count])
        print(
            f"{count:4d}  {speed:7.2f}  {every:20s}  {median(count, 'cpu_per_step'):9.4f}  {speed / median(0, 'steps_per_s'):17.2f}  "
            f"{fair:5.2f}  {cpu / median(0, 'cpu_share'):4.2f}"
        )


@app.command()
def one(steps: int) -> None:
    """One fit, as JSON on stdout."""
    import torch

    from mmsynth.field.warmup import warm_up
    from mmsynth.fitting.progress import FitProgress
    from mmsynth.fitting.run import fit
    from mmsynth.packaged import data_folder
    from mmsynth.scene.load import load_scene

    times: list[tuple[float, float]] = []

    def note(news: FitProgress) -> None:
        if news.step in (_BEGIN, _BEGIN + steps):
            times.append((time.perf_counter(), time.process_time()))

    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        fit(load_scene(data_folder("example_scene")), Path(folder), steps=_BEGIN + steps, on_step=note)
    (began, cpu_began), (ended, cpu_ended) = times
    seconds, cpu = ended - began, cpu_ended - cpu_began
    facts = {"steps_per_s": steps / seconds, "cpu_per_step": cpu / steps, "cpu_share": cpu / seconds, "threads": torch.get_num_threads()}
    print(json.dumps(facts))


@contextmanager
def _busy(count: int) -> Iterator[None]:
    """So many processes of one thread that never wait."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    app()
