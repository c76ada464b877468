"""Transducers: where their beams and pixels are."""
