"""Sums over the views of each texel, and their square-root form."""
