"""Error of sound in an image against closed forms, and its run time."""
