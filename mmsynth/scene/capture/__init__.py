"""Calibration boards in raw frames: where their corners are."""
