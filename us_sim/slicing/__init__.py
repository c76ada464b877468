"""Images cut from a volume that deformed tissue carries: probe, section, location, resampling."""
