"""B-mode images from the volume that deformed tissue carries."""
