"""What was seen: scene, sensors, photographs, masks, exposures."""
