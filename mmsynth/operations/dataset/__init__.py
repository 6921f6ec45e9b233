"""Pixel-aligned datasets of all modalities.

Start with ``generate``; ``aligned`` reads a dataset for training.
"""
