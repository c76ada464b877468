"""A scene: what its file may say, how that is read, and the objects it names."""
