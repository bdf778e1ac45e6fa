"""Texels of the surface, packed views, and the visibility of texels in views."""
