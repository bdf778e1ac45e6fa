"""Light of a capture: environment maps, prefiltering, light cells and their visibility."""
