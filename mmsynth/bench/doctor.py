"""The state of this machine: versions, threads, GPU, compiled kernels, and advice."""

from __future__ import annotations

import importlib.metadata
import platform
from typing import Any

import torch

from mmsynth.field.kernels import cpu
from mmsynth.threads import usable_cores

_PACKAGES = (
    "mmsynth",
    "torch",
    "numba",
    "numpy",
    "kornia",
    "opencv-contrib-python-headless",
    "scikit-image",
    "trimesh",
    "fast-simplification",
    "pymeshlab",
    "triton",
    "mitsuba",
)


def diagnose() -> dict[str, Any]:
    """Facts as one JSON-serialisable dict; ``advice`` holds one sentence per thing worth doing."""
    versions: dict[str, str | None] = {}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    gpu = torch.cuda.get_device_name(0) if torch.cuda.is_available() else None
    compiled, cores = cpu.is_compiled(), usable_cores()
    advice = []
    if not compiled:
        advice.append("The CPU kernels are not compiled yet: the first fit does it, once, and says so.")
    if torch.get_num_threads() > cores:
        advice.append(f"torch uses {torch.get_num_threads()} threads on {cores} cores: set OMP_NUM_THREADS={cores}.")
    if gpu:
        from mmsynth.field.kernels import cuda  # triton takes its time to import

        can, why = cuda.available()
        if not can:
            advice.append(f"GPU kernels unavailable ({why}): with --device cuda the field runs on torch operations, which are slower.")
    return {
        "python": platform.python_version(),
        "versions": versions,
        "cores": cores,
        "threads": torch.get_num_threads(),
        "gpu": gpu,
        "kernels_compiled": compiled,
        "kernels_in": str(cpu.kept_in()),
        "advice": advice,
    }


def render_text(facts: dict[str, Any]) -> str:
    """The facts as lines of text."""
    lines = [f"python {facts['python']}, {facts['cores']} cores, {facts['threads']} threads, GPU: {facts['gpu'] or 'none'}"]
    lines += [f"  {name} {version or 'not installed'}" for name, version in facts["versions"].items()]
    lines.append(f"CPU kernels compiled: {'yes, in ' + facts['kernels_in'] if facts['kernels_compiled'] else 'no'}")
    return "\n".join(lines + facts["advice"])
