"""What was measured: sensors, frames and their poses.

Start with ``scene`` (the dataclasses) and ``load`` (``load_scene``); ``layouts`` has one module for each layout on disk.
"""
