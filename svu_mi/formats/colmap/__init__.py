"""COLMAP: sparse models read, lenses straightened."""

from svu_mi.formats.colmap.source import read_colmap as read_colmap
