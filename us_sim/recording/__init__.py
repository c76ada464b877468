"""Bags: writing MCAP as rosbag2 does, reading what rosbag2 and this package wrote, probe paths."""
