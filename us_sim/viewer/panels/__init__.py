"""Panels of the page, each built inside the page."""
