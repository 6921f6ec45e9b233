"""How a field is learned from raw frames.

Start with ``run.fit``, the loop, and ``trainer``, one step of it. ``recipe`` has every number that can be chosen (recipes/README.md lists
them), ``needs`` what a scene asks for, ``decisions``, ``table_sizes`` and ``refinement`` what residuals decide on the way; ``choices`` is
the one form in which all of them say what they chose and why.
"""
