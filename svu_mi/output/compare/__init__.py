"""``svu compare``: differences between two results about one object, as numbers and a page."""
