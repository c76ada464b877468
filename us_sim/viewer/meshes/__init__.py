"""Meshes as they go to a page: what is told once, and the little that moves with every frame."""
