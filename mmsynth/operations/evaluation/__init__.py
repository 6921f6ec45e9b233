"""Scores on test views: ``evaluate`` of a field, ``conversions`` of its conversions."""
