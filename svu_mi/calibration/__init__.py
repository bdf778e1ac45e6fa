"""Calibration of captures: light, exposure gains, and consistency checks."""
