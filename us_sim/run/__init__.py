"""Running the nodes of a scene: as processes, followed until they end, or in lockstep."""
