"""Calibration of a capture: its light, exposures, and whether its parts fit each other."""
