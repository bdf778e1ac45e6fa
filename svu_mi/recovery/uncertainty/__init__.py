"""Uncertainty of recovered textures, as a Gaussian Markov random field."""
