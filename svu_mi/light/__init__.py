"""The light of a capture: read, filtered for lobes, gathered into cells."""
