"""Surfaces of labels."""
