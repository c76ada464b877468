"""Recording, playing and controlling sessions, beside the nodes that do it."""
