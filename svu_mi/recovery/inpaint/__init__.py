"""Filling of unseen texels by symmetry or a diffusion model, with uncertainty."""
