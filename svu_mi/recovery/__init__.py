"""SVBRDF recovery from photographs, uncertainty, and filling of unseen texels."""
