"""Cutting images from a deformed volume: one interface, one file a method."""
