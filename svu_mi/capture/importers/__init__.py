"""Importers of captures: NeRF and nerfstudio, COLMAP, IDR, and data sets."""
