"""Statistics of each texel: sums over its views, and their triangular factors."""
