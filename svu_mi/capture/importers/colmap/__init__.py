"""COLMAP: sparse models read, lenses straightened."""
