"""A haptic arm: its handle moves the probe, and feels the tissue."""
