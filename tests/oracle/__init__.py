"""The truth for all tests: NumPy in double precision, straight from the equations.

Clear over fast. Nothing here imports svu_mi, so that a mistake cannot be on both sides.
"""
