"""Freehand reconstruction: volumes from images of a moving probe."""
