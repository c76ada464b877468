"""Bags: writing MCAP as rosbag2 does, reading those of rosbag2 and this package, probe paths."""

MARKER = "session/marker"
"""The topic of texts that mark a moment, in the simulator's namespace."""
