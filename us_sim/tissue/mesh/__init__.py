"""Tetrahedral meshes: made, read, checked, mended; points and surfaces in them."""
