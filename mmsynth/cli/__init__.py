"""The command line."""

from mmsynth.cli.commands import app, main

__all__ = ["app", "main"]
