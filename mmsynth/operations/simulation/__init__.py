"""The digital twin of a sensor: raw frames as it would have recorded them, and its noise from frames that it did record."""
