"""Stiff and extreme cases, tried on every tissue solver."""
