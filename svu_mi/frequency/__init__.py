"""From samples to spectra: spherical harmonic fit (Eq. 12) and power spectrum (Eq. 8)."""
