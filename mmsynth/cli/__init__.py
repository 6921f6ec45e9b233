"""The command line: each command parses, calls one public function, and prints.

``capture``, ``fields``, ``products``, ``looking`` and ``bench`` have the commands, ``arguments`` their options, ``terminal`` what all of
them print with.
"""

import os

from mmsynth.cli import bench, capture, fields, looking, products
from mmsynth.cli.terminal import app

__all__ = ["app", "bench", "capture", "fields", "looking", "main", "products"]


def main() -> None:
    """Entry point of the ``mmsynth`` command."""
    # OpenMP's threads spin for milliseconds at every barrier by default, which stalls a fit beside another busy process. A short spin
    # costs nothing alone and was 1.6 times as fast beside one. Read when torch is loaded; a user's own setting stays.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    app()
