"""Scores of a hand: motion, force, areas, and exercises, under the names of the field."""
