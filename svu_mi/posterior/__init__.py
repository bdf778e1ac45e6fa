"""p(psi | B, L) on a grid of BRDF parameters, and its entropy."""
