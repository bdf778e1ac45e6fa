"""Files: EXR, npz, digests, and folders of results with one writer at a time."""
