"""The truth for all tests: NumPy in double precision, straight from the equations.

Clear over fast. What ``svu bench kernels`` needs as well stands in ``svu_mi.bench.oracle``,
which uses nothing else of svu_mi, so that a mistake cannot be on both sides.
"""
