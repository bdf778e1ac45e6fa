"""Importers of captures: NeRF and nerfstudio, COLMAP, LLFF, IDR, and data sets."""
