"""What a capture leaves open: its light, its exposures, and whether its parts fit each other."""
