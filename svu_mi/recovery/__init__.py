"""SVBRDF recovery: textures from photographs, their uncertainty, and what nobody saw."""
