"""Limits of sizes, checked before any work."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress

from svu_mi.core.memory import Size, address_space, cores, free_memory
from svu_mi.errors import CaptureError, OptionError, SceneError, SvuError

MAX_LANES = 2**32 - 1  # of one kernel
MAX_VIEWS = 10_000  # photographs are called view_0000 to view_9999
MAX_TEXELS = 2**14  # per side
# Mitsuba waits for Dr.Jit's workers to decode EXR files: for ever with one thread, which is the
# default on one core.
FEWEST_THREADS = 2
MIN_TEXELS = 2  # per side; Mitsuba has no texture below
TEXEL_BYTES = 2**8  # of the grid, laid out
PIXEL_BYTES = 16  # of a photograph in memory: three floats, a mask, and what can be used
RENDER_BYTES = 100  # per pixel of a film while it is rendered; measured: 90
MASK_LANES = 9  # rays per pixel that find the object
GIGA = 1e9


def ensure_threads(count: int = 0) -> None:
    """Have Dr.Jit use ``count`` threads (0: as many as now), but at least ``FEWEST_THREADS``."""
    import drjit as dr

    dr.set_thread_count(max(count or dr.thread_count(), FEWEST_THREADS))


def bootstrap() -> None:
    """Ensure two threads where there is one core; elsewhere Dr.Jit is not even imported."""
    if cores() < FEWEST_THREADS:
        with suppress(ImportError):  # svu doctor says what is wrong with it
            ensure_threads()


def require_memory(size: float, what: str, fix: str, error: type[SvuError] = OptionError) -> None:
    """Refuse what takes more than the free memory: "WHAT take at least 3 GB ...; FIX."."""
    known = [free_memory(), _unreserved()]
    free = min((room for room in known if room is not None), default=None)
    if free is not None and size > free:
        raise error(
            f"{what} take at least {size / GIGA:.3g} GB of memory, but only {free / GIGA:.3g} GB "
            f"are free; {fix}."
        )


def _unreserved() -> int | None:
    """Return bytes of address space that are left; None without a limit."""
    space = address_space()
    return None if space is None else max(space[0] - space[1], 0)


def require_files(more: int) -> None:
    """Let this process open so many more files; a system's default is 1024 in all, or 256."""
    try:
        import resource  # not on Windows
    except ImportError:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or (count := _open_files(soft) + more) <= soft:
        return
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (count, hard))
    except (OSError, ValueError) as error:
        raise CaptureError(
            f"Photographs in files need {count} open files, ulimit -n allows {soft}; raise it, or "
            "give --memory more."
        ) from error


def _open_files(most: int) -> int:
    """Return how many files this process has open; ``most`` where there is none left to ask by."""
    try:
        return len(os.listdir("/dev/fd"))
    except OSError:
        return most


def require_texels(resolution: Size, option: str) -> None:
    """Refuse a grid of texels that cannot be laid out."""
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
    """Refuse more sensors than can be worked with."""
    if count > MAX_VIEWS:
        raise error(f"{what}: at most {MAX_VIEWS} are supported, got {count}; leave some out.")


def require_spp(spp: int, option: str = "spp") -> None:
    """Refuse a number of samples per pixel that no film can take."""
    if not 1 <= spp <= MAX_LANES:
        raise OptionError(f"{option} must be at least 1 and below 2^32, got {spp}.")


def require_render(sizes: Sequence[Size], spp: int, label: str) -> None:
    """Refuse films that cannot be rendered, or not be kept."""
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
    """Refuse photographs that do not fit into memory."""
    width, height = max(sizes, default=(0, 0))
    fix = "make the films smaller" if rendering else "shrink them (svu import --shrink)"
    require_memory(
        rendering + PIXEL_BYTES * sum(w * h for w, h in sizes),
        f"{label}: {len(sizes)} photographs of up to {width} x {height} pixels",
        f"{fix}, or use fewer", CaptureError,
    )  # fmt: skip
