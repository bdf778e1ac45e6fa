"""Light of a capture: environment maps, prefiltering, light cells, visibility."""
