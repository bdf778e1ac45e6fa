"""COLMAP: sparse models read and written, lenses straightened."""

from svu_mi.formats.colmap.source import read_colmap as read_colmap
from svu_mi.formats.colmap.source import write_colmap as write_colmap
