"""Who sees whom: which view a texel, which texel what of the light."""
