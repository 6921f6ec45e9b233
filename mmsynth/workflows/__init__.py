"""Whole jobs that join several rooms.

Start with ``fit`` (a fit with its report) and ``runs`` (opening a run again); ``batch`` fits many scenes and makes a dataset of each.
"""
