"""Captures as other tools write them: NeRF and nerfstudio, COLMAP, Stanford-ORB, and the like."""
