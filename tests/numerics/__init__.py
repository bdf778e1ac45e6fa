"""Kernels against double precision, with every quantity driven to both of its ends.

A bound follows from the arithmetic (``oracle.rounding``). An error above it is a defect, and so is
a NaN, or an entropy outside [0, 1].
"""
