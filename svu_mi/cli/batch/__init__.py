"""Batch processing: list of captures, runner of steps, page of results."""
