"""The demo: the video its camera sees, what its session shows, one picture of it."""
