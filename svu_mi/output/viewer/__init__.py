"""``svu view``: entropy, textures and cameras in a browser (extra ``viewer``)."""
