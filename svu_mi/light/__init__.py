"""The light of a capture: read, filtered for lobes, in cells, and which of these texels see."""
