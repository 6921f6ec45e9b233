"""Speed against error, measured: each benchmark writes a table, a plot and JSON."""
