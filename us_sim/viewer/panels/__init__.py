"""The panels of the page: one a file, each built inside the page."""
