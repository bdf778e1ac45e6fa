"""SVBRDF recovery: textures from photographs."""
