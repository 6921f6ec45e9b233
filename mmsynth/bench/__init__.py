"""Speed against error, measured: each benchmark writes a table, a plot and JSON.

Start with ``fit``; ``jobs`` runs each fit in a process of its own, ``methods`` times ways to compute something beside each other.
``experiments`` are those of papers, of which ``paper`` makes the tables.
"""
