"""Sums over the views of a texel, and their square-root form, which the posterior reads."""
