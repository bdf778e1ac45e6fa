"""Ground truth and figures of merit: a path-traced posterior, metrics, predicted photographs.

Metrics are NumPy and SciPy. Nothing here returns NaN: where a figure is not defined, such as the
correlation with a constant, the docstring says what comes instead.
"""
