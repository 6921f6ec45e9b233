"""What was measured: sensors, frames and their poses.

Start with ``scene`` (the dataclasses) and ``load`` (``load_scene``, ``read_poses``); ``layouts`` has one module for each layout on disk.
Readers check what they read with ``checks``, so that every error names file and key in one sentence.
"""
