"""Evaluation: path-traced reference posterior, metrics, predicted photographs.

Metrics use NumPy and SciPy and never return NaN. Each docstring gives the metric's value in
undefined cases, such as the correlation with a constant.
"""
