"""Captures: scene, sensors, and photographs with masks and exposures."""
