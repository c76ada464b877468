"""A scene: the keys of its file, their reading, and the objects it names."""
