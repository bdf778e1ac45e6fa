"""Path-traced posterior of a few texels: what every estimator is measured against."""
