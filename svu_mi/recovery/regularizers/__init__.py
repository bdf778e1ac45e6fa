"""Regularisers: differentiable functions of a texture tensor."""
