"""Kills of a fit, each gone on with: python recipes/bench/kills.py [--kills 100].

A fit of the example scene is killed (SIGKILL) and resumed until it is done, then another one, until there were so many kills: at random
moments of its life, while a checkpoint is written, and while the files of its end are. Each field must become the same file as that of a
fit that was never killed, each checkpoint the same numbers, each log one in order, and nothing temporary may be left.
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from mmsynth.files import sha256_of
from mmsynth.fitting.checkpoint import read_checkpoint

_TIMED = 0.6  # of the kills; the others are aimed
_AIMS = ("checkpoint/.state.*", "checkpoint/.state.*", ".train.*", ".field.*", "field.safetensors", ".preview.*", ".report.*")


def main(
    kills: Annotated[int, typer.Option(min=1)] = 100,
    steps: Annotated[int, typer.Option(min=2, help="of each fit")] = 60,
    checkpoint_every: str = "0.3s",
    seed: int = 0,
) -> None:
    """Kill and resume; exit code 1 where a result differs."""
    rng = random.Random(seed)
    fell: Counter[str] = Counter()
    problems: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)

        def life(run: str) -> subprocess.Popen[str]:
            options = ["--run", f"runs/{run}", "--steps", str(steps), "--checkpoint-every", checkpoint_every, "--resume", "--json"]
            command = [sys.executable, "-m", "mmsynth", "fit", "example", *options]
            return subprocess.Popen(command, cwd=work, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

        _finish(life("whole"))  # compiles the kernels, if nobody has
        (work / "runs/whole").rename(work / "runs/first")
        began = time.perf_counter()
        _finish(life("whole"))
        whole, length = work / "runs/whole", time.perf_counter() - began
        print(f"a fit that is not killed: {length:.1f} s", flush=True)
        problems += [f"not killed, again: {p}" for p in _differences(work / "runs/first", whole)]
        fits = 0
        while fell.total() < kills:
            fits += 1
            run = work / f"runs/{fits}"
            here: list[str] = []
            process = life(run.name)
            while fell.total() + len(here) < kills and _kill(process, run, rng, length):
                here.append(_where(run))
                process = life(run.name)
            fell.update(here)
            said = process.communicate()[1]
            if process.returncode:
                problems.append(f"fit {fits}: exit code {process.returncode}: {said}")
            else:
                problems += [f"fit {fits}: {p}" for p in _differences(run, whole)]
            if (work / "runs/latest").resolve() != run.resolve():
                problems.append(f"fit {fits}: runs/latest is not it")
            print(f"fit {fits}: killed {', '.join(here) or 'never'}; {fell.total()} kills, {len(problems)} problems", flush=True)
    for where, count in fell.most_common():
        print(f"{count:4d}  {where}")
    print("\n".join(problems) if problems else f"{fell.total()} kills of {fits} fits: every field the same file, every checkpoint the same")
    raise typer.Exit(bool(problems))


def _finish(process: subprocess.Popen[str]) -> None:
    said = process.communicate()[1]
    if process.returncode:
        sys.exit(f"a fit that was not killed: exit code {process.returncode}: {said}")


def _kill(process: subprocess.Popen[str], run: Path, rng: random.Random, length: float) -> bool:
    """Kill it at a random moment; False where it was done before."""
    aim = None if rng.random() < _TIMED else rng.choice(_AIMS)
    try:
        process.wait(rng.uniform(0.0, length * (1.0 if aim is None else 0.8)))
    except subprocess.TimeoutExpired:
        pass
    while process.poll() is None and aim is not None and not any(run.glob(aim)):
        time.sleep(0.001)
    process.kill()  # nothing where it is done
    return process.wait() == -signal.SIGKILL


def _where(run: Path) -> str:
    """What a fit was doing when it was killed, by what it left."""
    left = sorted({path.name.split(".")[1] for path in run.rglob(".*.tmp*")})
    if left:
        return f"while {' and '.join(left)} was written"
    if (run / "report.html").exists():
        return "after its report"
    if (run / "manifest.json").exists():
        return "between its field and its report"
    if (run / "field.safetensors").exists():
        return "between its field and its manifest"
    return "while it learned" if (run / "checkpoint/state.pt").exists() else "before its first checkpoint"


def _differences(run: Path, whole: Path) -> list[str]:
    """In what a run is not as the one that was never killed."""
    found = []
    if sha256_of(run / "field.safetensors") != sha256_of(whole / "field.safetensors"):
        found.append("another field")
    ours, theirs = (_numbers(read_checkpoint(path)) for path in (run, whole))
    found += [f"checkpoint: {key}" for key in sorted({*ours, *theirs}) if not _same(ours.get(key), theirs.get(key))]
    logged = [json.loads(line)["step"] for line in (run / "train.jsonl").read_text().splitlines()]
    if logged != sorted(set(logged)) or logged[-1] != json.loads((whole / "train.jsonl").read_text().splitlines()[-1])["step"]:
        found.append(f"log: steps {logged}")
    found += [f"left: {path.name}" for path in run.rglob(".*")]
    found += [f"no {name}" for name in ("manifest.json", "report.html", "preview.png") if not (run / name).is_file()]
    return found


def _numbers(value: Any, key: str = "") -> dict[str, Any]:
    """The leaves of a checkpoint by name, but for the clock."""
    if isinstance(value, dict):
        return {k: v for name, part in value.items() if name != "elapsed" for k, v in _numbers(part, f"{key}.{name}").items()}
    if isinstance(value, (list, tuple)):
        return {k: v for index, part in enumerate(value) for k, v in _numbers(part, f"{key}.{index}").items()}
    return {key: value}


def _same(ours: Any, theirs: Any) -> bool:
    if isinstance(ours, torch.Tensor) and isinstance(theirs, torch.Tensor):
        return ours.dtype == theirs.dtype and ours.shape == theirs.shape and ours.numpy().tobytes() == theirs.numpy().tobytes()
    return bool(ours == theirs)


if __name__ == "__main__":
    typer.run(main)
