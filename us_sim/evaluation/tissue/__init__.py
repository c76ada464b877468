"""Error of every tissue solver against its run time."""
