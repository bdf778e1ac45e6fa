"""What every posterior of statistics asks of its arguments."""

from __future__ import annotations

import numpy as np

from svu_mi.errors import OptionError
from svu_mi.statistics import Factors


def require_scale(caller: str, scale: float) -> None:
    """Refuse a radiance that cannot be a unit.

    Raises:
        OptionError: it is not positive, or not finite.
    """
    if not (np.isfinite(scale) and scale > 0):
        raise OptionError(f"{caller}: scale must be positive, got {scale!r}.")


def total_texels(caller: str, factors: Factors, copies: int, texels: int | None) -> int:
    """Return how many texels there are: those asked for, or up to the last that has factors.

    Raises:
        OptionError: fewer than the factors' texels need, or copies below 1.
    """
    texel = factors.texel.numpy()
    last = int(texel.max()) if len(texel) else -1
    total = last + 1 if texels is None else texels
    if copies < 1 or total <= last:
        raise OptionError(
            f"{caller}: copies must be at least 1 and texels more than {last}, got "
            f"{copies} and {texels}."
        )
    return total
