"""Error of tracked poses against their run time."""
