"""What remains of the photographs: sums of all views, and what the posterior reads of them."""
