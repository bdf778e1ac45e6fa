"""Filling by a diffusion model (Sec. 5.3 of the paper)."""
