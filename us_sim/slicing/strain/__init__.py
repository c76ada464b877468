"""Strain images: the tissue's own strain along the beams, and an estimate as a scanner makes it."""
