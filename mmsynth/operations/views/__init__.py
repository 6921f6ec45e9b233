"""Where to look from, and what can be seen from there.

Start with ``load`` (poses files and ``trajectories``); ``coverage`` says how well training frames saw what a view sees.
"""
