"""The viewer: what it costs the simulator, and how long a page waits for an image."""
