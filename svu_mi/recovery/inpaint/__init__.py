"""Filling of unseen texels by symmetry or a diffusion model, with uncertainty.

Arrays (N, T) contain all N parameter values (RGB base colour, then the others) of T texels.
"""
