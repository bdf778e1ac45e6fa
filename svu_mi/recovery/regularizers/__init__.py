"""Regularisers: plain differentiable functions of texture tensors."""
