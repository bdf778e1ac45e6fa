"""What a comparison may be asked for: refused before anything is read."""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np

from svu_mi.errors import OptionError
from svu_mi.limits import require_texels
from svu_mi.options import preset as find_preset
from svu_mi.surface.layout import size_of


def two_presets(preset: Any) -> tuple[str, str]:
    """Return the name of a preset for each side, from one or two.

    Raises:
        OptionError: they are not one or two names of presets of the method ``angular``.
    """
    both = (preset, preset) if isinstance(preset, str) else preset
    pair = isinstance(both, tuple | list) and len(both) == 2
    if not (pair and all(isinstance(name, str) for name in both)):
        raise OptionError(
            f"compare(): preset takes the name of one preset, or two for a and b, got {preset!r}.",
            shell="--preset takes one preset, or two for A and B.",
        )
    first, second = (find_preset(name, method="angular").name for name in both)
    return first, second


def size_asked(resolution: Any) -> tuple[int, int] | None:
    """Return the (W, H) that is asked for by a number or two, None for None.

    Raises:
        OptionError: no map can have it.
    """
    if resolution is None:
        return None
    size = size_of(resolution)
    try:
        require_texels(size, "compare(): resolution")
    except OptionError as error:
        raise OptionError(str(error), shell=f"--{error.shell}") from None
    return size


def require_tolerance(tolerance: Any) -> None:
    """Refuse what is no difference that counts.

    Raises:
        OptionError: it is not a number, or below 0.
    """
    number = isinstance(tolerance, Real) and not isinstance(tolerance, bool)
    if not (number and 0 <= tolerance < np.inf):
        raise OptionError(
            f"compare(): tolerance must be a number, 0 or more, got {tolerance!r}.",
            shell=f"--tolerance must be 0 or more, got {tolerance:g}." if number else None,
        )
