"""Evaluation: path-traced reference posterior, metrics, predicted photographs.

Metrics use NumPy and SciPy and never return NaN. The docstring gives the value of undefined cases,
such as the correlation with a constant.
"""
