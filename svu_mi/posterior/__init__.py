"""Posterior p(psi | B, L) over BRDF parameters, and its entropy."""
