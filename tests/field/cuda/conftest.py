"""Triton against the torch reference: on a GPU where there is one, and in Triton's interpreter on the CPU.

Whether Triton compiles or interprets is decided when it is first imported. So the interpreter gets a process of its own (see
``test_cuda_interpreter``), where this folder runs a second time, with TRITON_INTERPRET=1 and CPU tensors in the place of CUDA tensors.
"""

import os
import sys
from pathlib import Path

import pytest
import torch

sys.path.append(str(Path(__file__).parents[1]))  # cases of the CPU's tests are those of Triton's

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"

if INTERPRETED:
    # the interpreter of triton 3.6 takes int() of arrays of one element for the bounds of a loop; numpy 2.4 has no such thing
    from triton.runtime import interpreter

    patch_tensor = interpreter._patch_lang_tensor

    def patch_tensor_and_index(tensor: object, scope: interpreter._LangPatchScope) -> None:
        patch_tensor(tensor, scope)
        scope.set_attr(tensor, "__index__", lambda self: int(self.handle.data.item()))

    interpreter._patch_lang_tensor = patch_tensor_and_index


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests with a ``device`` need a GPU or the interpreter; the others have nothing to do with the interpreter."""
    no_gpu = pytest.mark.skip(reason="needs a CUDA device")
    for item in items:
        if "field/cuda" not in item.path.as_posix():
            continue
        if "device" not in getattr(item, "fixturenames", ()):
            if INTERPRETED:
                item.add_marker(pytest.mark.skip(reason="has nothing to do with the interpreter"))
        elif not INTERPRETED:
            item.add_marker(pytest.mark.gpu)
            if not torch.cuda.is_available():
                item.add_marker(no_gpu)


@pytest.fixture
def device() -> str:
    torch.manual_seed(0)
    return "cpu" if INTERPRETED else "cuda"
