"""Sequences of tracked images."""
