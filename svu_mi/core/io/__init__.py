"""Files: EXR, NPZ, JSON, digests, and result folders with one writer at a time."""
