"""Settings: their units, ranges, choices, and one reader for all of them."""
