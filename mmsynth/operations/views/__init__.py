"""Where to look from, and what can be seen from there."""
