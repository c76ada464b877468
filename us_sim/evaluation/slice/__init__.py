"""Error of every slicing method against its run time."""
