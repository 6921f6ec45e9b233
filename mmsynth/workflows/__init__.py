"""Whole jobs that join several rooms: many scenes, a fit and a dataset of each."""
