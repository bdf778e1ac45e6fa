"""Captures as other tools write them: NeRF and nerfstudio, COLMAP, LLFF, IDR, and the like."""
