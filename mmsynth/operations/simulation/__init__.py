"""The digital twin of a sensor: the raw frames that it would have recorded.

Start with ``simulate``; ``plan`` decides how a field stands in for a sensor, ``frames`` makes one frame, ``calibrate_noise`` measures the
noise of a captured sensor.
"""
