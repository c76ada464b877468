"""Scales, outlines and letters on an image for the eye."""
