"""Evaluation: path-traced reference posterior, and errors of textures and images.

Metrics use NumPy and SciPy and never return NaN. Each docstring gives the metric's value in
undefined cases, such as the similarity of equal images.
"""
