"""Sources of the probe's pose, filters, calibration."""
