"""Running the nodes of a scene: as processes, in lockstep, and as a demo with its pictures."""
