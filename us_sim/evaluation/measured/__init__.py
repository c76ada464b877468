"""Error against measurements of the real world."""
