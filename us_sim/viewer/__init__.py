"""The simulator in a browser: one page, its server, and what streams to it."""
