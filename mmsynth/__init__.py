"""mmsynth: one radiance field of a scene from the raw frames of several sensors, and what no rig could capture from it."""

__version__ = "0.1.0"
