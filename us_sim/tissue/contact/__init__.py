"""Contact of the probe with the surface of the tissue."""
