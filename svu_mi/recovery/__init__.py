"""SVBRDF recovery: textures from photographs, their uncertainty, and filling of unseen texels."""
