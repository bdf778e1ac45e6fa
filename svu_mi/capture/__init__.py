"""A capture: scene, sensors, photographs with masks and exposures."""
