"""Uncertainty of recovered textures: a Gaussian Markov random field around them."""
