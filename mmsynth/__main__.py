"""``python -m mmsynth``."""

from mmsynth.cli import main

main()
