"""Estimation of the light of a capture from its photographs."""
