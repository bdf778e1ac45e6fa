"""Environment light: maps, prefiltering, light cells, visibility."""
