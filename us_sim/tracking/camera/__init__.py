"""A camera that sees markers: bodies, lenses, corners, poses."""
