"""Texels of a UV-mapped mesh as surface points, their neighbours, gutters around their charts."""
