"""Texels that no photograph shows: filled by symmetry or by a model, with their uncertainty."""
