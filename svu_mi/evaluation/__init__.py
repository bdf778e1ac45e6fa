"""How good an uncertainty is, against a reference posterior and against the truth; how good
recovered textures are, and pictures made with them.

Plain NumPy and SciPy. Nothing here returns NaN: where a figure is not defined, such as the
correlation with a constant, the docstring says what comes instead.
"""
