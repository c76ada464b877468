"""Where the probe is: sources of poses, filters, calibration."""
