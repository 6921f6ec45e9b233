"""Which back end serves a GPU, what is said where Triton's cannot, and the interpreter's own process."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch

from mmsynth.field import kernels
from mmsynth.field.kernels import cpu, cuda, reference
from mmsynth.field.kernels.cuda import shared


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")
def test_all_of_this_folder_in_the_interpreter() -> None:
    command = [sys.executable, "-m", "pytest", "-n0", "-p", "no:cacheprovider", str(Path(__file__).parent)]
    run = subprocess.run(command, env=os.environ | {"TRITON_INTERPRET": "1"}, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-5000:] + run.stderr[-2000:]
    assert "passed" in run.stdout


def _module_without_triton(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setitem(sys.modules, "triton", None)  # an import of it now fails
    spec = importlib.util.spec_from_file_location("cuda_without_triton", shared.__file__)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_imports_without_triton_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _module_without_triton(monkeypatch).available() == (False, "triton is not installed")


def test_all_modules_import_without_triton() -> None:
    program = "import sys; sys.modules['triton'] = None; from mmsynth.field.kernels import cuda; print(cuda.available()[1])"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert run.stdout == "triton is not installed\n", run.stderr


def test_availability_has_a_reason_of_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    can, why = cuda.available()
    assert can is (why == "") and "\n" not in why
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(shared, "triton", object())
    assert cuda.available() == (False, "torch sees no CUDA device")


def test_a_broken_toolchain_is_a_reason_not_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise RuntimeError("Failed to find C compiler.\nPlease specify one.")

    monkeypatch.setattr(torch, "zeros", fail)
    assert shared._probe.__wrapped__() == (False, "no triton kernel can be run: Failed to find C compiler.")


def test_a_triton_or_a_gpu_that_is_too_old_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(shared, "triton", SimpleNamespace(__version__="3.4.0"))
    assert cuda.available() == (False, "triton 3.4.0 is older than 3.5")
    monkeypatch.setattr(shared, "triton", SimpleNamespace(__version__="3.6.0"))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (7, 5))
    assert cuda.available() == (False, "a GPU of compute capability 7.5, not 8.0 or later")


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")
def test_triton_says_what_it_compiles(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(shared, "_made", [])
    hook = shared.triton.knobs.runtime.jit_cache_hook
    assert cuda.made() == 0
    assert [hook(key="", repr=name, fn=None, compile=None) for name in ("march", "look")] == [False, False]  # it goes on
    assert cuda.made() == 2 and capsys.readouterr().err.count("preparing GPU kernels") == 1


class _OnGpu:
    """What the choice of a backend asks a tensor."""

    def __init__(self, dtype: torch.dtype) -> None:
        self.device, self.dtype = torch.device("cuda"), dtype


@pytest.mark.parametrize("can", [True, False])
def test_the_backend_follows_the_tensor_and_what_is_missing_is_said_once(
    can: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cuda, "available", lambda: (True, "") if can else (False, "no compiler"))
    kernels._on_gpu.cache_clear()
    try:
        assert [kernels._backend(_OnGpu(torch.float32)) for _ in range(3)] == [cuda if can else reference] * 3
        assert capsys.readouterr().err == ("" if can else "GPU kernels unavailable (no compiler): using torch operations\n")
        assert kernels._backend(_OnGpu(torch.float64)) is kernels._backend(torch.ones(1).double()) is reference
        assert kernels._backend(torch.ones(1)) is cpu
    finally:
        kernels._on_gpu.cache_clear()
