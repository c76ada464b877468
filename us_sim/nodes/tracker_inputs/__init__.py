"""What the probe tracker listens to: one file for each source that a scene may name."""
