"""Next best view: candidate views ranked by expected entropy (Sec. 5.1, Eq. 13)."""
