"""Values in groups of four, which a kernel reads and writes at once (``dr.gather`` of a Vector4f).

Where lanes read from different places, that takes about a third of the time of one by one.
"""

from __future__ import annotations

QUAD = 4


def fours(count: int) -> int:
    """Return how many groups so many values take."""
    return -(-count // QUAD)


def padded(count: int) -> int:
    """Return how many values have the room that ``count`` take."""
    return QUAD * fours(count)
