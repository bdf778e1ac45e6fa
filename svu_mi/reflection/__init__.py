"""The reflection model: radiance of a texel under the light of a capture (Eq. 6)."""
