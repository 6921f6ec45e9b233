"""Results to look at: ``report`` writes the HTML page of a run, ``text`` prints tables in the terminal."""
