"""``svu compare``: differences between two results for one object, as numbers and a page."""
