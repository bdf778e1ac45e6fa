"""The truth for all tests and studies: NumPy in double precision, straight from the equations.

Clear over fast. Nothing here uses anything of svu_mi, so that a mistake cannot be on both sides
(``numerics/test_oracle.py`` holds this). Presets and grids are only read: their switches and
nodes say which equations are meant.
"""
