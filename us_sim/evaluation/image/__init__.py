"""Error of what an image shows of sound, strain and flow against closed forms, and its run time."""
