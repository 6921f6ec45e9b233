"""Results to look at: ``report.html`` of a run, and tables in the terminal."""
