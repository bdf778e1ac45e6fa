"""Environment light: maps, prefiltering, light cells, and their visibility from texels."""
