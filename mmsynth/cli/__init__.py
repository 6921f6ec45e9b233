"""The command line: each command parses, calls one public function, and prints.

``capture``, ``fields``, ``products``, ``looking`` and ``bench`` have the commands, ``arguments`` their options, ``terminal`` what all of
them print with.
"""

from mmsynth.cli import bench, capture, fields, looking, products
from mmsynth.cli.terminal import app
from mmsynth.process import set_up

__all__ = ["app", "bench", "capture", "fields", "looking", "main", "products"]


def main() -> None:
    """Entry point of the ``mmsynth`` command."""
    set_up()
    app()
