"""The command `us-sim`, and its work on files: calibrations, volumes, recordings."""
