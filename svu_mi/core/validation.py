"""Checks of arguments before any work: types, ranges, sizes, memory."""

from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any, get_type_hints

import numpy as np

from svu_mi.core.checked_arguments import mismatch
from svu_mi.core.memory import GIGA, Size, address_space, free_memory
from svu_mi.errors import CaptureError, OptionError, SceneError, SvuError

MAX_LANES = 2**32 - 1  # per kernel launch
MAX_VIEWS = 10_000  # photographs are named view_0000 to view_9999
MAX_TEXELS = 2**14  # per side
MIN_TEXELS = 2  # per side; Mitsuba has no texture below
TEXEL_BYTES = 2**8  # per texel of the grid, including those outside of all charts
PIXEL_BYTES = 16  # per pixel of a photograph in memory: three floats and two masks
RENDER_BYTES = 100  # per pixel of a film during rendering; measured: 90
MASK_LANES = 9  # rays per pixel that render the object's mask


def require(options: Any, condition: bool, name: str, expected: str) -> None:
    """Raise OptionError unless a condition on the option ``name`` holds."""
    if not condition:
        raise OptionError(
            f"{type(options).__name__}: {name} must be {expected}, got {getattr(options, name)!r}."
        )


def require_known(names: Iterable[str], known: Iterable[str], what: str) -> None:
    """Check that all names are valid.

    Args:
        names: names to check.
        known: valid names.
        what: noun for a name in the message, such as ``fix``.

    Raises:
        OptionError: a name is not valid.
    """
    there = tuple(known)
    for name in names:
        if name not in there:
            raise OptionError(f"Unknown {what} {name!r}; use one of {', '.join(there)}.")


def require_types(options: Any) -> None:
    """Check the types of the fields of an option object.

    Raises:
        OptionError: a field has another type than annotated.
    """
    hints = get_type_hints(type(options))
    for name in (each.name for each in fields(options) if each.init):
        if problem := mismatch(getattr(options, name), hints[name]):
            raise OptionError(f"{type(options).__name__}: {name}{problem}")


def require_ranges(options: Any, **ranges: tuple[float, float]) -> None:
    """Check that options, given by name, are in [low, high].

    Raises:
        OptionError: an option is out of range or NaN.
    """
    for name, (low, high) in ranges.items():
        require(options, low <= getattr(options, name) <= high, name, f"in [{low:g}, {high:g}]")


def require_memory(size: float, what: str, fix: str, error: type[SvuError] = OptionError) -> None:
    """Raise ``error`` if ``size`` bytes exceed the free memory or address space.

    ``what`` (a plural) is the subject of the message, and ``fix`` its remedy.
    """
    known = [free_memory()]
    if (space := address_space()) is not None:
        known.append(max(space[0] - space[1], 0))
    free = min((room for room in known if room is not None), default=None)
    if free is not None and size > free:
        raise error(
            f"{what} take at least {size / GIGA:.3g} GB of memory, but only {free / GIGA:.3g} GB "
            f"are free; {fix}."
        )


def require_texels(resolution: Size, option: str) -> None:
    """Raise OptionError if a texel grid has invalid sides or needs too much memory."""
    width, height = resolution
    if min(resolution) < MIN_TEXELS or max(resolution) > MAX_TEXELS:
        raise OptionError(
            f"{option} must be {MIN_TEXELS} to {MAX_TEXELS} texels per side, got {width} x "
            f"{height}."
        )
    require_memory(
        width * height * TEXEL_BYTES, f"{option}: {width} x {height} texels", "use fewer"
    )


def require_views(count: int, what: str, error: type[SvuError] = OptionError) -> None:
    """Raise ``error`` if there are more than ``MAX_VIEWS`` views."""
    if count > MAX_VIEWS:
        raise error(f"{what}: at most {MAX_VIEWS} are supported, got {count}; use fewer.")


def indices_of(numbers: Any, count: int, label: str, noun: str) -> np.ndarray:
    """Return indices below ``count``, int64, given as such or as flags, one per ``noun``.

    Raises:
        OptionError: an index is out of range, or there are fewer or more flags than ``count``.
    """
    given = np.ravel(numbers)
    if given.dtype == bool and len(given) != count:
        raise OptionError(f"{label}: {len(given)} flags for {count} {noun}s; give one per {noun}.")
    if given.dtype == bool:
        return np.flatnonzero(given)
    whole = given.dtype.kind in "iu"
    wrong = given[(given < 0) | (given >= count)] if whole else given
    if len(wrong):
        raise OptionError(
            f"{label}: no {noun} {wrong[0]}; {noun}s are numbered from 0 to {count - 1}."
        )
    return given.astype(np.int64)


def require_spp(spp: int, option: str = "spp") -> None:
    """Raise OptionError unless 1 <= spp < 2^32 (samples per pixel)."""
    if not 1 <= spp <= MAX_LANES:
        raise OptionError(f"{option} must be at least 1 and below 2^32, got {spp}.")


def require_render(sizes: Sequence[Size], spp: int, label: str) -> None:
    """Raise an SvuError if films are too large to render or to keep in memory."""
    width, height = max(sizes, key=lambda size: size[0] * size[1], default=(1, 1))
    pixels = width * height
    if pixels * MASK_LANES > MAX_LANES:
        raise SceneError(
            f"{label}: a film of {width} x {height} pixels is too large to render; "
            f"use at most {MAX_LANES // MASK_LANES} pixels."
        )
    if pixels * spp > MAX_LANES:
        raise OptionError(
            f"spp must be at most {MAX_LANES // pixels} for a film of {width} x {height} pixels "
            f"(2^32 samples at a time), got {spp}."
        )
    require_photographs(sizes, label, RENDER_BYTES * pixels)


def require_photographs(sizes: Sequence[Size], label: str, rendering: int = 0) -> None:
    """Raise CaptureError if photographs and ``rendering`` further bytes exceed the memory."""
    width, height = max(sizes, default=(0, 0))
    fix = "make the films smaller" if rendering else "shrink them (svu import --shrink)"
    require_memory(
        rendering + PIXEL_BYTES * sum(w * h for w, h in sizes),
        f"{label}: {len(sizes)} photographs of up to {width} x {height} pixels",
        f"{fix}, or use fewer", CaptureError,
    )  # fmt: skip
