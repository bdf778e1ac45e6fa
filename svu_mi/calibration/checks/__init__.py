"""Checks whether cameras, object, light and photographs fit each other."""
