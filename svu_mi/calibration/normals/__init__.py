"""Shading normals: tilted smoothly so that the model agrees with the photographs."""
