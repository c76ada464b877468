"""The simulator in a browser: one page, its server, and its streams."""
