"""``python -m mmsynth``."""

from mmsynth.cli.commands import main

main()
