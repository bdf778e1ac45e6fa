"""Import of COLMAP projects."""
