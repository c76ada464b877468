"""Filters of poses, and which poses are not believed."""
