"""Readers of image formats: header, colour space and stored pixels."""
