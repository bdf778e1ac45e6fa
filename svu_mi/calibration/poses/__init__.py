"""Poses: cameras moved so that outlines and textures agree with the photographs."""
