"""What a fit chose for its scene, and why: one form for what was known at the start and for what residuals decided on the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")


@dataclass(frozen=True)
class Choice(Generic[Value]):
    """``why``: one line, a switch's begins with "on: " or "off: ". ``changed``: whether it is other than off, or than what is usual."""

    value: Value
    why: str
    changed: bool


def switch(on: bool, why: str) -> Choice[bool]:
    """A part of the field or of the fit that is there or not."""
    return Choice(on, f"{'on' if on else 'off'}: {why}", on)


def summary(choices: Mapping[str, Choice[Any]], verbose: bool = False) -> list[str]:
    """One line for each choice that changed something; ``verbose``: for all of them."""
    return [f"{name}: {choice.why}" for name, choice in choices.items() if verbose or choice.changed]


def choices_of(manifest: Mapping[str, Any]) -> dict[str, Choice[Any]]:
    """All choices of a finished fit, from the manifest of its run."""
    return {name: Choice(**stored) for name, stored in manifest.get("needs", {}).get("choices", {}).items()}
