"""Bags: writing MCAP as rosbag2 does, reading those of rosbag2 and this package, probe paths."""
