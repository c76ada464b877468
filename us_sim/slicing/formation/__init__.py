"""From echoes to grey values: gain, resolution, thickness of the beam, contact."""
