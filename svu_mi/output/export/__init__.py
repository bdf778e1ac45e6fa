"""Results as assets of other programs: GLB, MaterialX, PNG, packed textures."""
