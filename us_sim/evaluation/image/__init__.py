"""Error of sound, strain and flow in an image against closed forms, and its run time."""
