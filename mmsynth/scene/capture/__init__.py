"""From raw frames of calibration boards to what a scene needs to know of its cameras."""
