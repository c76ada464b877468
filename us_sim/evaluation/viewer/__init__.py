"""The viewer: its cost to the simulator, and how long a page waits for an image."""
