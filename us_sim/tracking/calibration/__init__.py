"""Calibration of cameras, styluses, landmarks, probes and clocks."""
