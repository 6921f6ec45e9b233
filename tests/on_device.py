"""Cases of the CPU's tests for a GPU: made on the CPU, whose random numbers they take, and moved."""

from __future__ import annotations

import dataclasses
from types import ModuleType
from typing import Any

import pytest
import torch


def moved(value: Any, device: str) -> Any:
    """Tensors and modules on the device, in tuples, dicts and dataclasses, too; parameters stay leaves."""
    if isinstance(value, torch.nn.Module):
        return value.to(device)
    if isinstance(value, torch.nn.Parameter):
        return torch.nn.Parameter(value.detach().to(device))
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {name: moved(x, device) for name, x in value.items()}
    if isinstance(value, tuple):
        parts = [moved(x, device) for x in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(value, **{f.name: moved(getattr(value, f.name), device) for f in dataclasses.fields(value)})
    return value


def make_on_cpu(module: ModuleType, name: str, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a function of a module of tests makes goes to the device."""
    make = getattr(module, name)

    def made(*args: Any, **kwargs: Any) -> Any:
        with torch.device("cpu"):
            return moved(make(*args, **kwargs), device)

    monkeypatch.setattr(module, name, made)
