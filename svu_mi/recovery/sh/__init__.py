"""Recovery by the reflection model of the angular estimator (Eq. 6)."""
