"""``svu compare``: two results about one object, side by side."""
