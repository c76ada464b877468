"""Calibration: what the data of cameras, styluses, landmarks, images and clocks determine."""
