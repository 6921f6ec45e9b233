"""The command line: each command parses, calls one public function, and prints.

``fields``, ``products`` and ``bench`` have the commands, ``arguments`` their options, ``terminal`` what all of them print with.
"""

from mmsynth.cli import bench, fields, products
from mmsynth.cli.terminal import app

__all__ = ["app", "bench", "fields", "main", "products"]


def main() -> None:
    """Entry point of the ``mmsynth`` command."""
    app()
