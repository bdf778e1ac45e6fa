"""Which photograph to take next: expected entropy of views (Sec. 5.1, Eq. 13)."""
